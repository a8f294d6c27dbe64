"""What temperature and pressure do to refractive indices, which are those against the air around.

Catalogues hold for air of one atmosphere at the temperature of their measurements, about 20 degrees Celsius.
"""

from dataclasses import dataclass

STANDARD_C = 20.0


@dataclass(frozen=True)
class Environment:
    """Temperature of glass and air in degrees Celsius, and pressure of the air in atmospheres (0: vacuum)."""

    temperature_c: float = STANDARD_C
    pressure_atm: float = 1.0


@dataclass(frozen=True)
class Thermal:
    """How a glass follows temperature.

    Attributes
    ----------
    coefficients : tuple of float
        D0, D1, D2, E0, E1 and l_tk of `change`, in powers of 1/K and um.
    at_c : float
        Temperature to which its dispersion belongs.
    """

    coefficients: tuple[float, ...]
    at_c: float = STANDARD_C


def air_index(wavelength_um: float, environment: Environment) -> float:
    """Return the index of air (Kohlrausch 1968, Praktische Physik), as lens design programs take it.

    It agrees with Ciddor (1996) to 4e-8 in the visible.
    """
    w2 = wavelength_um**2
    excess = 1e-8 * (6432.8 + 2949810 * w2 / (146 * w2 - 1) + 25540 * w2 / (41 * w2 - 1))
    thin = 1 + 3.4785e-3 * (environment.temperature_c - 15.0)
    return 1 + excess * environment.pressure_atm / thin


def change(index: float, thermal: Thermal, wavelength_um: float, temperature_c: float) -> float:
    """Return by how much the absolute index of a glass has changed (Schott, TIE-19, Eq. 8).

    Parameters
    ----------
    index : float
        At the temperature to which its dispersion belongs.
    thermal : Thermal
    wavelength_um, temperature_c : float
    """
    d0, d1, d2, e0, e1, resonance = thermal.coefficients
    t = temperature_c - thermal.at_c
    strength = (e0 + e1 * t) * t / (wavelength_um**2 - abs(resonance) * resonance)
    return (index**2 - 1) / (2 * index) * (((d2 * t + d1) * t + d0) * t + strength)
