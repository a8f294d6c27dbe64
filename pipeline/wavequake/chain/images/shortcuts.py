"""What every exposure workflow stores of a moving image: the full exposure, two shortcuts, their errors."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.chain.images.camera import frame_axes
from wavequake.chain.images.extended import ObjectSection, image_measures, object_image
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.imaging.exposures.exposure_models import (
    cut,
    exposure_error,
    full_exposure,
    gaussian_exposure,
    los_exposure,
)

Array = NDArray[np.float64]

# The shortcuts, in the order of the dimension `shortcut`.
SHORTCUTS = ("los_only", "gaussian")
# Defocus of scans through focus: Noll coefficients c_4 in waves.
FOCUS = (-0.5, -0.25, 0.0, 0.25, 0.5)
# Local images are computed on a canvas of this many frames, so that light moves in from outside the frame.
CANVAS = 2


def exposed(
    images: Iterable[NDArray[np.floating]],
    static: NDArray[np.floating],
    los: Array,
    pixels: int,
    sampling: float,
    area: float,
    diameter: float,
    shown: ObjectSection | None = None,
) -> dict[str, Array]:
    """Expose local images (instants, n, n) in full and by the shortcuts; returns `exposure_measures`.

    ``static`` (n, n) is the local image at rest and ``los`` (instants, 2) the line of sight in lambda/D; area
    and diameter of the pupil set the scale of encircled energies. ``shown`` is an object to image, too.
    """
    lit = shown if shown and shown.light == "incoherent" else None
    canvas = full_exposure(images, los, sampling)
    full = cut(canvas, pixels)
    shortcuts = [cut(model(static, los, sampling), pixels) for model in (los_exposure, gaussian_exposure)]
    errors = [exposure_error(image, full, sampling, area, diameter) for image in shortcuts]
    ee50, ee80 = encircled_energy_radius(full, (0.5, 0.8), sampling, area, diameter)
    return {
        "exposure": full,
        **({"object_image": object_image(lit, canvas, pixels, sampling, area, diameter)} if lit else {}),
        **{f"exposure_{name}": image for name, image in zip(SHORTCUTS, shortcuts, strict=True)},
        "peak": np.asarray(full.max()),
        "ee50": ee50,
        "ee80": ee80,
        "image_error": np.array([error.l2 for error in errors]),
        "peak_error": np.array([error.peak for error in errors]),
        "ee50_error": np.array([error.ee50 for error in errors]),
        "ee80_error": np.array([error.ee80 for error in errors]),
    }


def exposure_measures(dim: str, shown: ObjectSection | None = None) -> Iterator[Measure]:
    """Yield what `exposed` returns for each entry of the dimension `dim`."""
    frame, kinds = (dim, "y", "x"), (dim, "shortcut")
    yield from image_measures((dim,), shown)
    words = "image at rest convolved with the line of sight's trajectory (Störkle 2018, Eq. 3.80)"
    yield stored("exposure_los_only", "1", words, frame)
    words = "image at rest blurred by a Gaussian of the trajectory's mean and covariance"
    yield stored("exposure_gaussian", "1", words, frame)
    words = "L2 norm of the difference of the shortcut's and the full image, of unit energy each"
    yield stored("image_error", "1", words, kinds)
    yield stored("peak_error", "1", "shortcut's largest irradiance over the full exposure's, minus 1", kinds)
    for share in (50, 80):
        words = f"shortcut's minus the full exposure's radius of {share} % encircled energy"
        yield stored(f"ee{share}_error", "lambda/D", f"{words}; NaN beyond the frame", kinds)


def exposure_axes(pixels: int, sampling: float) -> dict[str, Axis]:
    """Return the dimensions y, x, axis, shortcut and focus."""
    return {
        **frame_axes(pixels, sampling),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        "focus": Axis(FOCUS, "Noll coefficient c_4 added to the wavefront, in waves", "1"),
        "shortcut": Axis(SHORTCUTS, "how the exposure is approximated"),
    }
