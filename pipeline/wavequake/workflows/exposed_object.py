"""What an exposure shows of an extended object in incoherent light: a slit, a grating, a chart, stars."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.signal import fftconvolve

from wavequake.errors import UserError
from wavequake.imaging import objects
from wavequake.imaging.detector import pixel_means
from wavequake.imaging.exposure_models import cut
from wavequake.imaging.image_formation import star_field_image
from wavequake.workflows.contract import Variable
from wavequake.workflows.schema import Section

Array = NDArray[np.float64]


class ObjectSection(Section):
    """The object whose image is exposed, too, in incoherent light; one key only. Lengths in lambda/D."""

    slit: float | None = Field(default=None, gt=0, description="width of a slit along y")
    double_slit: list[float] | None = Field(
        default=None, min_length=2, max_length=2, description="width of two slits along y, and their distance"
    )
    grating: float | None = Field(
        default=None, gt=0, description="period of a grating along x whose slits are as wide as its bars"
    )
    chart: list[float] | None = Field(
        default=None, min_length=1, description="widths of the bars of a resolution chart"
    )
    stars: list[list[float]] | None = Field(
        default=None,
        min_length=1,
        description="x, y and flux of each star; 1 is a pixel of brightness 1",
    )

    def chosen(self) -> tuple[str, float | list[float] | list[list[float]]]:
        """Return the key that is given, and its value.

        Raises
        ------
        UserError
            If it is not exactly one.
        """
        given = [(name, value) for name, value in self if value is not None]
        if len(given) != 1:
            names = ", ".join(name for name, _ in given) or "none"
            raise UserError(
                f"[object] takes exactly one of {', '.join(type(self).model_fields)}; it has {names}"
            )
        return given[0]


def object_image(
    section: ObjectSection, exposure: Array, sampling: float, area: float, diameter: float
) -> Array:
    """Return the image (n, n) of an object that has the frame of an exposure (n, n) and is dark beyond.

    In incoherent light every point of the object makes the same exposure. 1 is the brightness of an evenly
    lit plane: area and diameter of the pupil say what share of a point's light a pixel of the exposure holds.

    Raises
    ------
    UserError
        If the object is impossible or does not fit into the frame.
    """
    name, value = section.chosen()
    pixels = len(exposure)
    spread = exposure * (sampling**2 * area / diameter**2)
    if name == "stars":
        table = [star for star in value if isinstance(star, list)] if isinstance(value, list) else []
        if any(len(star) != 3 for star in table):
            raise UserError("each of object.stars needs three numbers: x, y and flux")
        stars = np.array(table)
        reach = np.abs(stars[:, :2]).max()
        if reach > 0.5 * pixels * sampling:
            raise UserError(
                f"object.stars reach {reach:g} lambda/D, beyond the frame of {pixels * sampling:g}"
            )
        border = pixels // 2 + 1
        return cut(star_field_image(np.pad(spread, border), stars[:, :2], stars[:, 2], sampling), pixels)
    picture = _picture(name, value, pixels, sampling)
    first = pixels // 2
    spread = pixel_means(spread, sampling, sampling)  # what is lit is a square, not a point
    return np.asarray(fftconvolve(picture, spread)[first : first + pixels, first : first + pixels])


def object_variable(dim: str, count: int, pixels: int) -> dict[str, Variable]:
    """Describe the images of an object for each of `count` entries of the dimension `dim`."""
    attrs = {
        "units": "1",
        "long_name": "exposed image of the object in incoherent light; 1 = an evenly lit plane",
    }
    return {"object_image": Variable((dim, "y", "x"), (count, pixels, pixels), attrs)}


def _picture(name: str, value: object, pixels: int, sampling: float) -> Array:
    shape = (pixels, pixels)
    if name == "slit":
        return objects.slit(shape, sampling, float(np.asarray(value)))
    if name == "double_slit":
        width, distance = np.asarray(value)
        return objects.double_slit(shape, sampling, float(width), float(distance))
    if name == "grating":
        return objects.grating(shape, sampling, float(np.asarray(value)))
    return objects.resolution_chart(shape, sampling, np.asarray(value))
