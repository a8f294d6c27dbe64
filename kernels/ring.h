// Zernike polynomials over a ring by recurrences: they stay accurate where sums of monomials cancel. With
// z = u + i v and t = |z|^2 the sum is the real part of that of z^m times (C_m(t) - i S_m(t)), whose cosine
// and sine parts are sums of polynomials P_k(t), each of which follows from the two before.
//
// READ takes a coefficient, and EACH is how far they are apart; the host tells their order and the steps
// (kernels/trace/ring.py).

// A sum and its derivative.
typedef struct { real value, slope; } series;

// Horner's rule in z, one step: z h + (a + i b).
#define HORNER(h, h_i, a, b) \
    do { \
        const real before = h; \
        h = h * u + ((a) - h_i * v); \
        h_i = h_i * u + (before * v + (b)); \
    } while (0)

// The sum h, its derivatives e along z and w along t; C_m and S_m by Clenshaw's recurrence and its derivative.
INLINE real ring_sum(__global const double *a, const int degree, __global const double *step, real u, real v,
                     real *slope_u, real *slope_v)
{
    const real t = u * u + v * v;
    real h = 0.0, h_i = 0.0, e = 0.0, e_i = 0.0, w = 0.0, w_i = 0.0;
    for (int m = degree; m >= 0; --m) {
        const int count = (degree - m) / 2 + 1;
        // Without a sine the cosine is taken twice; what comes of it is multiplied by 0.
        __global const double *sines = m > 0 ? a + EACH * count : a;
        const double scale = step[0], sine_scale = m > 0 ? -scale : 0.0;
        series c = {READ(a), 0.0}, s = {READ(sines), 0.0};
        series c2 = {0.0, 0.0}, s2 = {0.0, 0.0};
        step += 1;
        for (int k = 1; k < count; ++k) {
            const real factor = step[0] * t + step[1];
            const series c1 = c, s1 = s;
            c.slope = factor * c1.slope + (step[0] * c1.value - step[2] * c2.slope);
            c.value = factor * c1.value + (READ(a + EACH * k) - step[2] * c2.value);
            s.slope = factor * s1.slope + (step[0] * s1.value - step[2] * s2.slope);
            s.value = factor * s1.value + (READ(sines + EACH * k) - step[2] * s2.value);
            c2 = c1;
            s2 = s1;
            step += 3;
        }
        HORNER(e, e_i, h, h_i);
        HORNER(h, h_i, scale * c.value, sine_scale * s.value);
        HORNER(w, w_i, scale * c.slope, sine_scale * s.slope);
        a = sines + EACH * count;
    }
    *slope_u = e + 2.0 * u * w;
    *slope_v = 2.0 * v * w - e_i;
    return h;
}
