// Heights in closed form (wavequake/kernels/trace/forms_numpy.py has their twins): each function returns one and
// adds its slopes to *slope_x and *slope_y. NaN where a surface does not reach out so far.

// a[0] r + a[1] r^2 + ...
INLINE real radial(__global const double *a, const int count, real x, real y, real *slope_x, real *slope_y)
{
    const real r = root(x * x + y * y);
    real value = 0.0, derivative = 0.0;
    for (int i = count - 1; i >= 0; --i) {
        derivative = derivative * r + value;
        value = value * r + a[i];
    }
    // At the tip of a cone the slope counts as 0.
    const real factor = EITHER(r > 0.0, (value + derivative * r) / r, (real)0.0);
    *slope_x += factor * x;
    *slope_y += factor * y;
    return value * r;
}

// Curvatures along x and y; 1 + conic constant times their squares.
INLINE real biconic(__global const double *a, const int count, real x, real y, real *slope_x, real *slope_y)
{
    const real edge = root(1.0 - a[2] * (x * x) - a[3] * (y * y)), inverse = 1.0 / (1.0 + edge);
    const real value = (a[0] * (x * x) + a[1] * (y * y)) * inverse, steep = value * inverse / edge;
    *slope_x += x * (2.0 * a[0] * inverse + a[2] * steep);
    *slope_y += y * (2.0 * a[1] * inverse + a[3] * steep);
    return value;
}

// The curve z(y) of curvature a[1], with a[2] = (1 + conic constant) a[1]^2 and even powers a[3] ..., turned
// about an axis parallel to y at z = 1 / a[0].
INLINE real toroid(__global const double *a, const int count, real x, real y, real *slope_x, real *slope_y)
{
    const real square = y * y, edge = root(1.0 - a[2] * square);
    real even = 0.0, derivative = 0.0;
    for (int i = count - 1; i >= 3; --i) {
        derivative = derivative * square + even;
        even = even * square + a[i];
    }
    const real curve = a[1] * square / (1.0 + edge) + even * square;
    const real steep = y * (a[1] / edge + 2.0 * (even + derivative * square));
    const real around = a[0] / (1.0 - a[0] * curve), rim = root(1.0 - around * around * (x * x));
    *slope_x += around * x / rim;
    *slope_y += steep / rim;
    return curve + around * (x * x) / (1.0 + rim);
}

// The sum of Chebyshev polynomials a[k] T_k(t), and its derivative.
INLINE real chebyshev(__global const double *a, const int count, real t, real *derivative)
{
    real b = 0.0, former = 0.0, d = 0.0, before = 0.0;
    for (int k = count - 1; k >= 1; --k) {
        const real next_d = 2.0 * b + 2.0 * t * d - before;
        const real next_b = a[k] + 2.0 * t * b - former;
        before = d;
        d = next_d;
        former = b;
        b = next_b;
    }
    *derivative = b + t * d - before;
    return a[0] + t * b - former;
}

// Forbes' departure from a conic along its normal: 1 / radius^2 of the aperture, k c^2 and (1 + k) c^2 of the
// conic, and the sum of Q_m(w), w = (r / radius)^2, by Chebyshev polynomials of 2 w - 1.
INLINE real qbfs(__global const double *a, const int count, real x, real y, real *slope_x, real *slope_y)
{
    const real square = x * x + y * y, w = a[0] * square;
    const real over = 1.0 - a[1] * square, under = 1.0 - a[2] * square;
    real rise;
    const real sum = chebyshev(a + 3, count - 3, 2.0 * w - 1.0, &rise), lean = root(over / under);
    const real bump = w * (1.0 - w) * lean, value = bump * sum;
    const real slope = a[0] * ((1.0 - 2.0 * w) * lean * sum + 2.0 * bump * rise)
                     + 0.5 * value * (a[2] / under - a[1] / over);
    *slope_x += 2.0 * slope * x;
    *slope_y += 2.0 * slope * y;
    return value;
}

// Forbes' departure from a conic along the axis: 1 / radius^2 and the sum, as above.
INLINE real qcon(__global const double *a, const int count, real x, real y, real *slope_x, real *slope_y)
{
    const real w = a[0] * (x * x + y * y);
    real rise;
    const real sum = chebyshev(a + 1, count - 1, 2.0 * w - 1.0, &rise);
    const real slope = 2.0 * a[0] * w * (sum + w * rise);
    *slope_x += 2.0 * slope * x;
    *slope_y += 2.0 * slope * y;
    return w * w * sum;
}
