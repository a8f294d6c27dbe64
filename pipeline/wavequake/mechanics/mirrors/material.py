"""Isotropic linear elastic materials."""

from dataclasses import dataclass

from wavequake.errors import UserError


@dataclass(frozen=True)
class Material:
    """Young's modulus in Pa, Poisson's ratio, density in kg/m^3."""

    young: float
    poisson: float
    density: float

    def __post_init__(self) -> None:
        if not self.young > 0:
            raise UserError(f"Young's modulus is {self.young} Pa; it must be positive")
        if not -1 < self.poisson < 0.5:
            raise UserError(f"Poisson's ratio is {self.poisson}; it must lie between -1 and 0.5")
        if not self.density > 0:
            raise UserError(f"the density is {self.density} kg/m^3; it must be positive")

    @property
    def lame(self) -> tuple[float, float]:
        """Lame's parameters: lambda and the shear modulus mu, in Pa."""
        shear = self.young / (2 * (1 + self.poisson))
        return 2 * shear * self.poisson / (1 - 2 * self.poisson), shear


ALUMINUM = Material(young=70e9, poisson=0.33, density=2700.0)
# Typical data-sheet values of a lithium-aluminosilicate glass ceramic such as Zerodur.
GLASS_CERAMIC = Material(young=90.3e9, poisson=0.24, density=2530.0)
