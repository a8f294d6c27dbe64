"""What an exposure shows of an extended object: a slit, a grating, a chart, stars, a picture of one's own."""

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from wavequake.campaign.measures import Measure, stored
from wavequake.campaign.schema import Section
from wavequake.chain.images.picture import in_frame, picture_of
from wavequake.errors import UserError
from wavequake.imaging.exposures.detector import pixel_means
from wavequake.imaging.exposures.exposure_models import cut
from wavequake.imaging.objects import shapes as objects
from wavequake.imaging.objects.formation import star_field_image

Array = NDArray[np.float64]


# The keys that say what the object is.
_KINDS = ("slit", "double_slit", "grating", "chart", "stars", "picture")


class ObjectSection(Section):
    """The object whose image is exposed, too: one of its kinds, and its light. Lengths in lambda/D."""

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
    picture: str | None = Field(
        default=None,
        exclude=True,
        description="PNG, NPY or CSV file of a picture or mask (read when the study is loaded), one value of "
        "at least 0 per pixel of the frame; PNGs are upright, of others the first row is the lowest",
    )
    picture_data: str | None = Field(default=None, description="the content of that file")
    light: Literal["incoherent", "coherent", "partial"] = Field(
        default="incoherent",
        description="light of the object; if it is not incoherent, the object holds amplitudes",
    )
    sigma: float | None = Field(
        default=None,
        gt=0,
        le=2,
        description='partial coherence factor of light = "partial": radius of the source over the pupil\'s',
    )

    def chosen(self) -> tuple[str, float | list[float] | list[list[float]] | str]:
        """Return the kind of object that is given, and its value.

        Raises
        ------
        UserError
            If it is not exactly one, or its light does not fit.
        """
        values = {name: getattr(self, name) for name in _KINDS} | {"picture": self.picture_data}
        given = [(name, value) for name, value in values.items() if value is not None]
        if len(given) != 1:
            names = ", ".join(name for name, _ in given) or "none"
            raise UserError(f"[object] takes exactly one of {', '.join(_KINDS)}; it has {names}")
        if (self.light == "partial") != (self.sigma is not None):
            raise UserError(
                'object.sigma belongs to object.light = "partial", which needs it; the light is '
                f'"{self.light}", sigma {"missing" if self.sigma is None else format(self.sigma, "g")}'
            )
        if given[0][0] == "stars" and self.light != "incoherent":
            raise UserError(f'stars shine incoherently; object.light is "{self.light}"')
        return given[0]


def object_image(
    section: ObjectSection, exposure: Array, pixels: int, sampling: float, area: float, diameter: float
) -> Array:
    """Return the image (pixels, pixels) of an object that fills the frame and is dark beyond.

    In incoherent light every point of the object makes the same exposure (n, n). Where that is twice as wide
    as the frame, each point's light is followed through the whole frame. 1 is the brightness of an evenly
    lit plane: area and diameter of the pupil say what share of a point's light a pixel of the exposure holds.

    Raises
    ------
    UserError
        If the object is impossible or does not fit into the frame.
    """
    name, value = section.chosen()
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
        spread = np.maximum(spread, 0.0)  # images that were moved ring to 1e-10 of their peak below zero
        return cut(star_field_image(np.pad(spread, border), stars[:, :2], stars[:, 2], sampling), pixels)
    picture = object_picture(section, pixels, sampling)
    spread = pixel_means(spread, sampling, sampling)  # what is lit is a square, not a point
    # As scipy.signal.fftconvolve does, whose package takes half a second to load, in every worker.
    size = [
        scipy.fft.next_fast_len(a + b - 1, True) for a, b in zip(picture.shape, spread.shape, strict=True)
    ]
    whole = scipy.fft.irfft2(scipy.fft.rfft2(picture, size) * scipy.fft.rfft2(spread, size), size)
    first = len(spread) // 2
    return np.asarray(whole[first : first + pixels, first : first + pixels])


def check_object(section: ObjectSection, pixels: int, sampling: float) -> None:
    """Raise UserError if an object is impossible or does not fit into the frame."""
    if section.light == "incoherent":
        object_image(section, np.zeros((pixels, pixels)), pixels, sampling, 1.0, 1.0)
    else:
        object_picture(section, pixels, sampling)


def lit_object_words(shown: ObjectSection) -> str:
    """Say what an object is lit by, and what 1 means in its image."""
    light = "partially coherent" if shown.light == "partial" else shown.light
    one = "an evenly lit plane" + ("" if light == "incoherent" else " whose light all passes the pupil")
    return f"the object in {light} light; 1 = {one}"


def object_picture(section: ObjectSection, pixels: int, sampling: float) -> Array:
    """Return the object (pixels, pixels), what its kind is but for stars.

    Raises
    ------
    UserError
        If the object is impossible or does not fit into the frame.
    """
    name, value = section.chosen()
    shape = (pixels, pixels)
    if isinstance(value, str):
        return in_frame(picture_of(value), pixels)
    if name == "slit":
        return objects.slit(shape, sampling, float(np.asarray(value)))
    if name == "double_slit":
        width, distance = np.asarray(value)
        return objects.double_slit(shape, sampling, float(width), float(distance))
    if name == "grating":
        return objects.grating(shape, sampling, float(np.asarray(value)))
    return objects.resolution_chart(shape, sampling, np.asarray(value))


def image_measures(
    over: tuple[str, ...],
    shown: ObjectSection | None,
    focus: bool = False,
    words: str = "mean of every instant's image at its line of sight; 1 = peak of the perfect one",
    attrs: Mapping[str, str] | None = None,
) -> Iterator[Measure]:
    """Yield the measures of exposures, in `words`, over dimensions such as ``("field",)``; of an object, too.

    With `focus` there are exposures in planes behind the image. `attrs` are further ones of the exposure.
    """
    frame = (*over, "y", "x")
    about = "largest irradiance of the exposure, line of sight included; 1 = peak of the perfect image"
    yield stored("peak", "1", about, over)
    for share in (50, 80):
        about = f"radius of {share} % encircled energy of the exposure; inf beyond the frame"
        yield stored(f"ee{share}", "lambda/D", about, over)
    yield stored("exposure", "1", words, frame, attrs=attrs or {})
    if focus:
        about = "exposure in planes behind the image; 1 = peak of the perfect image"
        yield stored("exposure_focus", "1", about, (*over, "focus", "y", "x"))
    if shown is not None:
        yield stored("object_image", "1", "exposed image of " + lit_object_words(shown), frame)
