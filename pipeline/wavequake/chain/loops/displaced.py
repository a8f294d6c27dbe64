"""A sensor that is shifted, turned or magnified against the pupil."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from wavequake.campaign.schema import Section
from wavequake.optics.polynomials.zernike import annular_zernike_gradient

Array = NDArray[np.float64]


class Placed(Section):
    """Where a sensor stands against the pupil; controllers believe that it stands right."""

    shift: tuple[float, float] = Field(
        default=(0.0, 0.0), strict=False, description="of the sensor along x and y, in radii of the pupil"
    )
    rotation_deg: float = Field(default=0.0, ge=-360, le=360, description="of the sensor, from x to y")
    magnification: float = Field(
        default=1.0, ge=0.1, le=10, description="of the sensor's grid over the pupil"
    )

    @field_validator("shift")
    @classmethod
    def _sees_the_pupil(cls, value: tuple[float, float]) -> tuple[float, float]:
        if np.hypot(*value) > 1.0:
            raise ValueError(
                f"it is {value[0]:g}, {value[1]:g} radii, so that the sensor stands beside the pupil; shift "
                "it by 1 or less"
            )
        return value


@dataclass(frozen=True)
class Seen:
    """Polynomials at points of a sensor and their slopes along its own axes, (N, J); per radius."""

    values: Array
    by_x: Array
    by_y: Array


def seen_through(placed: Placed | None, x: Array, y: Array, terms: int, obscuration: float) -> Seen:
    """Return the pupil's polynomials as a sensor sees them at its own places; None: it stands right."""
    if placed is None:
        return Seen(*annular_zernike_gradient(x, y, terms, obscuration))
    angle, size = np.radians(placed.rotation_deg), placed.magnification
    cosine, sine = np.cos(angle), np.sin(angle)
    at_x = placed.shift[0] + size * (cosine * x - sine * y)
    at_y = placed.shift[1] + size * (sine * x + cosine * y)
    values, by_x, by_y = annular_zernike_gradient(at_x, at_y, terms, obscuration)
    return Seen(values, size * (cosine * by_x + sine * by_y), size * (cosine * by_y - sine * by_x))
