// Polynomials in u and v of total degree `degree`: the coefficient of u^i v^j is number
// (i + j) (i + j + 1) / 2 + j. READ takes a coefficient, and EACH is how far they are apart.
//
// Horner's rule in v, then in u; rows of equal powers of u go in pairs, so that there is enough to do at once.
// Rows stay loops: straight lines are put in an order that takes more registers than there are.

#define TERM(i, j) (a + EACH * (((i) + (j)) * ((i) + (j) + 1) / 2 + (j)))

INLINE real monomial_value(__global const double *a, const int degree, real u, real v)
{
    real value = READ(TERM(degree, 0));
    if (degree % 2)
        value = value * u + (READ(TERM(degree - 1, 1)) * v + READ(TERM(degree - 1, 0)));
    #pragma unroll 16
    for (int i = degree / 2 * 2 - 1; i > 0; i -= 2) {
        __global const double *term = TERM(i, degree - i - 1);
        real first = READ(TERM(i, degree - i)) * v + READ(term);
        real second = READ(TERM(i - 1, degree - i + 1)) * v + READ(TERM(i - 1, degree - i));
        second = second * v + READ(term + EACH * (1 - degree));
        #pragma unroll 1
        for (int n = degree - 2; n >= i; --n) {
            term -= EACH * (n + 2);
            first = first * v + READ(term);
            second = second * v + READ(term - EACH * n);
        }
        value = value * u + first;
        value = value * u + second;
    }
    return value;
}

INLINE real monomial_sum(__global const double *a, const int degree, real u, real v, real *slope_u,
                         real *slope_v)
{
    real value = READ(TERM(degree, 0)), along_u = 0.0, along_v = 0.0;
    if (degree % 2) {
        along_u = value;
        along_v = READ(TERM(degree - 1, 1));
        value = value * u + (along_v * v + READ(TERM(degree - 1, 0)));
    }
    #pragma unroll 16
    for (int i = degree / 2 * 2 - 1; i > 0; i -= 2) {
        __global const double *term = TERM(i, degree - i - 1);
        real first_v = READ(TERM(i, degree - i)), first = first_v * v + READ(term);
        real second_v = READ(TERM(i - 1, degree - i + 1)), second = second_v * v + READ(TERM(i - 1, degree - i));
        second_v = second_v * v + second;
        second = second * v + READ(term + EACH * (1 - degree));
        #pragma unroll 1
        for (int n = degree - 2; n >= i; --n) {
            term -= EACH * (n + 2);
            first_v = first_v * v + first;
            second_v = second_v * v + second;
            first = first * v + READ(term);
            second = second * v + READ(term - EACH * n);
        }
        along_u = along_u * u + value;
        along_v = along_v * u + first_v;
        value = value * u + first;
        along_u = along_u * u + value;
        along_v = along_v * u + second_v;
        value = value * u + second;
    }
    *slope_u = along_u;
    *slope_v = along_v;
    return value;
}
