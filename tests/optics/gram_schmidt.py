"""Radial Zernike polynomials by Gram-Schmidt in as many digits as the decimal context has."""

from decimal import Decimal


def gram_schmidt(m, count, eps):
    """Ascending coefficients in t = rho^2 of P_k, orthonormal over the annulus: Z = rho^m P_k(rho^2) cos."""

    def moment(power):
        return (1 - start ** (power + 1)) / ((power + 1) * (1 - start))

    def inner(a, b):
        return sum(p * q * moments[i + j] for i, p in enumerate(a) for j, q in enumerate(b))

    start = Decimal(eps) ** 2
    moments = [moment(m + power) for power in range(2 * count)]
    polynomials = []
    for k in range(count):
        new = [Decimal(0)] * k + [Decimal(1)]
        for old in polynomials:
            share = inner(new, old)
            new = [c - share * (old[i] if i < len(old) else 0) for i, c in enumerate(new)]
        length = inner(new, new).sqrt()
        polynomials.append([c / length for c in new])
    return polynomials
