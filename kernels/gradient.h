// Media whose refractive index varies: n^2 = m[0] + sum of a[k] (x^2 + y^2)^(k + 1) + sum of b[k] z^(k + 1) in
// the frame of the surface that begins the medium. `m` holds n^2 at the origin, the length of a step, then
// the a and the b, as many as `radial` and `axial` say.
//
// With dt = ds / n the ray equation becomes r'' = grad(n^2) / 2, and dr/dt = n d is the optical ray vector. A
// step is that of Runge, Kutta and Nystroem of fourth order (Sharma, Kumar and Ghatak 1982).

typedef struct { triple place, vector; real path; } bent;

// Sum of a[k] x^(k + 1).
INLINE real powers(__global const double *a, const int count, real x)
{
    real total = 0.0;
    #pragma unroll
    for (int k = count - 1; k >= 0; --k)
        total = (total + a[k]) * x;
    return total;
}

INLINE real powers_slope(__global const double *a, const int count, real x)
{
    real total = 0.0;
    #pragma unroll
    for (int k = count; k > 0; --k)
        total = total * x + k * a[k - 1];
    return total;
}

INLINE real squared_index(__global const double *m, const int radial, const int axial, triple p)
{
    return m[0] + powers(m + 2, radial, p.x * p.x + p.y * p.y) + powers(m + 2 + radial, axial, p.z);
}

// Half the gradient of n^2.
INLINE triple half_gradient(__global const double *m, const int radial, const int axial, triple p)
{
    const real across = powers_slope(m + 2, radial, p.x * p.x + p.y * p.y);
    triple bend = {across * p.x, across * p.y, 0.5 * powers_slope(m + 2 + radial, axial, p.z)};
    return bend;
}

INLINE bent bent_step(__global const double *m, const int radial, const int axial, bent r, real h)
{
    const triple start = half_gradient(m, radial, axial, r.place);
    const triple b = half_gradient(m, radial, axial,
                                   along(along(r.place, 0.5 * h, r.vector), 0.125 * h * h, start));
    const triple c = half_gradient(m, radial, axial, along(along(r.place, h, r.vector), 0.5 * h * h, b));
    const real sixth = h / 6.0;
    const triple twice = {start.x + 2.0 * b.x, start.y + 2.0 * b.y, start.z + 2.0 * b.z};
    const triple whole = {twice.x + 2.0 * b.x + c.x, twice.y + 2.0 * b.y + c.y, twice.z + 2.0 * b.z + c.z};
    bent end;
    end.place = along(along(r.place, h, r.vector), h * sixth, twice);
    end.vector = along(r.vector, sixth, whole);
    // The path is the integral of n^2 dt: the trapezoidal rule with its end correction.
    const real bend = dot3(start, r.vector) - dot3(half_gradient(m, radial, axial, end.place), end.vector);
    const real ends = squared_index(m, radial, axial, r.place) + squared_index(m, radial, axial, end.place);
    end.path = r.path + h * (0.5 * ends + sixth * bend);
    return end;
}

INLINE bent chosen(mask condition, bent yes, bent no)
{
    bent a = {choose(condition, yes.place, no.place), choose(condition, yes.vector, no.vector),
              EITHER(condition, yes.path, no.path)};
    return a;
}

INLINE real size_of(real a) { return EITHER(a < 0.0, -a, a); }
INLINE real largest_of(triple a) { return larger(size_of(a.x), larger(size_of(a.y), size_of(a.z))); }

INLINE triple turned_by(const double *a, triple p)
{
    triple b = {a[0] * p.x + a[1] * p.y + a[2] * p.z, a[3] * p.x + a[4] * p.y + a[5] * p.z,
                a[6] * p.x + a[7] * p.y + a[8] * p.z};
    return b;
}

INLINE triple turned_back_by(const double *a, triple p)
{
    triple b = {a[0] * p.x + a[3] * p.y + a[6] * p.z, a[1] * p.x + a[4] * p.y + a[7] * p.z,
                a[2] * p.x + a[5] * p.y + a[8] * p.z};
    return b;
}

// The pose that leads through `count` poses, one after the other.
INLINE void lead_through(__global const double *poses, const int count, double *pose)
{
    for (int i = 0; i < 12; ++i)
        pose[i] = poses[i];
    for (int next = 1; next < count; ++next) {
        __global const double *b = poses + 12 * next;
        double before[12];
        for (int i = 0; i < 12; ++i)
            before[i] = pose[i];
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k)
                pose[3 * i + k] = b[3 * i] * before[k] + b[3 * i + 1] * before[3 + k] + b[3 * i + 2] * before[6 + k];
            pose[9 + i] = b[3 * i] * before[9] + b[3 * i + 1] * before[10] + b[3 * i + 2] * before[11] + b[9 + i];
        }
    }
}

// Of a ray's last step, relative to the step and the distance from the origin.
#define ON_SURFACE 1e-13
#define MOST_CUTS 60
// A ray that takes so many times the way along the axis does not arrive.
#define DETOUR 20.0
#define LEAST_STEPS 100.0
#define MOST_STEPS 1e5
