"""What a camera makes of exposures: counts of a detector with noise, and how sharp the image is.

The same for every optics: a system's fields or the one of a segmented telescope.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.schema import Section
from wavequake.errors import UserError
from wavequake.imaging.exposures.detector import detector_pixels, expected_photons, pixels_across, read_out
from wavequake.imaging.exposures.sharpness import sharpness
from wavequake.mechanics.disturbances.motion import generator

Array = NDArray[np.float64]

_MM_PER_UM = 1e-3


class SharedImagingSection(Section):
    """What the images of every optics may have besides."""

    focus_um: tuple[float, ...] = Field(
        default=(),
        strict=False,
        max_length=33,
        description="exposures in planes so far behind the image (along the light), stored as exposure_focus",
    )
    resolution: bool = Field(
        default=False,
        description="measure how sharp exposures are: fwhm, two_point (Rayleigh), sparrow and mtf50",
    )

    _new: ClassVar[tuple[str, ...]] = ("focus_um", "resolution")  # left out of the identity if not given

    @model_serializer(mode="wrap")
    def _nothing_is_said_of_what_is_not_asked_for(
        self, handler: SerializerFunctionWrapHandler
    ) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        return {key: value for key, value in record.items() if key not in self._new or key in self.asked}

    @property
    def asked(self) -> list[str]:
        """Keys of what images may have besides that are not as they are without them."""
        fields = type(self).model_fields
        return [key for key in self._new if getattr(self, key) != fields[key].default]


class DetectorSection(Section):
    """The detector that counts the photons of every exposure."""

    pixel_um: float = Field(gt=0, description="width of a pixel; they leave no gaps")
    photons: float = Field(
        gt=0,
        le=1e15,
        description="electrons that all the light of a point at rest makes during an exposure",
    )
    read_noise: float = Field(default=0.0, ge=0, le=1e6, description="rms of a reading, electrons")


@dataclass(frozen=True)
class Camera:
    """What makes numbers of the exposures of a study.

    Attributes
    ----------
    pixels, sampling
        Of exposures; lambda/D.
    areas : tuple of float
        Of the pupil of each field, in the unit of ``diameter`` squared.
    diameter : float
        Length that defines lambda/D in the pupil.
    resolution_mm : float
        lambda/D in the image.
    sharp : bool
        Whether to measure how sharp exposures are.
    detector : DetectorSection, optional
    """

    pixels: int
    sampling: float
    areas: tuple[float, ...]
    diameter: float
    resolution_mm: float
    sharp: bool
    detector: DetectorSection | None = None

    @property
    def width(self) -> float:
        """Width of a detector's pixel, lambda/D."""
        assert self.detector is not None
        return self.detector.pixel_um * _MM_PER_UM / self.resolution_mm


def require_pixels(camera: Camera) -> None:
    """Raise UserError if the pixels of a detector do not suit the frame."""
    if camera.detector is None:
        return
    try:
        pixels_across(camera.pixels, camera.sampling, camera.width)
    except UserError:
        frame = camera.pixels * camera.sampling * camera.resolution_mm / _MM_PER_UM
        raise UserError(
            f"detector.pixel_um = {camera.detector.pixel_um:g} does not suit the frame of {camera.pixels} x "
            f"{camera.sampling:g} lambda/D, which is {frame:.4g} um wide: it should hold 1 to 4096 pixels "
            "along each axis"
        ) from None


def seen(camera: Camera, exposures: Array, random: np.random.Generator) -> dict[str, Array]:
    """Return what a camera makes of the exposures (fields, n, n) of a case, by measure (fields, ...)."""
    found: dict[str, list[Array]] = {}
    for exposure, area in zip(exposures, camera.areas, strict=True):
        numbers = sharpness(exposure, camera.sampling) if camera.sharp else {}
        if camera.detector is not None:
            expected = expected_counts(camera, exposure, area)
            brightest, noise = expected.max(), camera.detector.read_noise
            counts = read_out(expected, noise, random)
            numbers |= {"counts": counts, "snr": brightest / np.sqrt(max(brightest, 0.0) + noise**2 + 1e-300)}
        for name, values in numbers.items():
            found.setdefault(name, []).append(np.asarray(values))
    return {name: np.stack(values) for name, values in found.items()}


def expected_counts(camera: Camera, exposure: Array, area: float) -> Array:
    """Return the mean number of electrons of each pixel (p, p) in an exposure (n, n)."""
    assert camera.detector is not None
    means = detector_pixels(exposure, camera.sampling, camera.width)
    return expected_photons(means, camera.width, area, camera.diameter, camera.detector.photons)


def noise_of(seed: int, population: str, realization: int) -> np.random.Generator:
    """Return the random numbers of a detector in a realization of a population."""
    return generator(seed, f"~detector/{population}", realization)  # no disturbance can have this name


def camera_measures(
    sharp: bool, detector: DetectorSection | None, over: tuple[str, ...]
) -> Iterator[Measure]:
    """Yield the measures of a camera, over dimensions such as ``("field",)``."""
    if sharp:
        for name, units, words in (
            ("fwhm", "lambda/D", "full width at half maximum of the exposure"),
            ("two_point", "lambda/D", "distance of two points with a saddle of 0.735 (Rayleigh)"),
            ("sparrow", "lambda/D", "distance of two points that just have no saddle (Sparrow)"),
            ("mtf50", "D/lambda", "frequency at which the exposure leaves half of the contrast"),
        ):
            yield stored(name, units, words + "; NaN beyond the frame", (*over, "axis"))
    if detector is not None:
        words = "electrons that the detector reads, noise included"
        yield stored("counts", "1", words, (*over, "detector_y", "detector_x"))
        words = "signal of the brightest pixel over its noise, expected"
        yield stored("snr", "1", words, over)


def frame_axes(pixels: int, sampling: float) -> dict[str, Axis]:
    """Return the dimensions of a frame, by the middles of its pixels."""
    along = (np.arange(pixels) - pixels // 2) * sampling
    return {name: Axis(along, f"image {name}", "lambda/D") for name in ("y", "x")}


def camera_axes(camera: Camera) -> dict[str, Axis]:
    """Return the dimensions of a detector's pixels."""
    if camera.detector is None:
        return {}
    across = pixels_across(camera.pixels, camera.sampling, camera.width)
    along = (np.arange(across) - across // 2) * camera.detector.pixel_um
    return {name: Axis(along, "middle of a pixel", "um") for name in ("detector_y", "detector_x")}
