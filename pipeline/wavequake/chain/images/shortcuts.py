"""What every exposure workflow stores of a moving image: the full exposure, two shortcuts, their errors."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Variable
from wavequake.chain.images.extended import ObjectSection, object_image, object_variable
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
    """Expose local images (instants, n, n) in full and by the shortcuts; returns `exposure_variables`.

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


def exposure_variables(
    dim: str, count: int, pixels: int, shown: ObjectSection | None = None
) -> dict[str, Variable]:
    """Describe what `exposed` returns for each of `count` entries of the dimension `dim`."""

    def variable(dims: tuple[str, ...], shape: tuple[int, ...], units: str, long_name: str) -> Variable:
        return Variable((dim, *dims), (count, *shape), {"units": units, "long_name": long_name})

    frame, kinds = (("y", "x"), (pixels, pixels)), (("shortcut",), (len(SHORTCUTS),))
    radius = "radius of {} % encircled energy of the exposure; inf beyond the frame"
    off = "shortcut's minus the full exposure's radius of {} % encircled energy; NaN beyond the frame"
    return {
        **(object_variable(shown, dim, count, pixels) if shown else {}),
        "exposure": variable(
            *frame, "1", "mean of every instant's own image at its line of sight; 1 = peak of the perfect one"
        ),
        "exposure_los_only": variable(
            *frame,
            "1",
            "image at rest convolved with the line of sight's trajectory (Störkle 2018, Eq. 3.80)",
        ),
        "exposure_gaussian": variable(
            *frame, "1", "image at rest blurred by a Gaussian of the trajectory's mean and covariance"
        ),
        "peak": variable((), (), "1", "largest irradiance of the exposure; 1 = peak of the perfect image"),
        "ee50": variable((), (), "lambda/D", radius.format(50)),
        "ee80": variable((), (), "lambda/D", radius.format(80)),
        "image_error": variable(
            *kinds, "1", "L2 norm of the difference of the shortcut's and the full image, of unit energy each"
        ),
        "peak_error": variable(
            *kinds, "1", "shortcut's largest irradiance over the full exposure's, minus 1"
        ),
        "ee50_error": variable(*kinds, "lambda/D", off.format(50)),
        "ee80_error": variable(*kinds, "lambda/D", off.format(80)),
    }


def frame_coordinates(
    pixels: int, sampling: float
) -> dict[str, tuple[tuple[str, ...], NDArray[np.generic], dict[str, str]]]:
    """Return the coordinates y, x, axis, shortcut and focus."""
    along = (np.arange(pixels) - pixels // 2) * sampling
    return {
        "y": (("y",), along, {"units": "lambda/D", "long_name": "image y"}),
        "x": (("x",), along, {"units": "lambda/D", "long_name": "image x"}),
        "axis": (("axis",), np.array(["x", "y"], dtype=object), {"long_name": "axis of the image plane"}),
        "focus": (
            ("focus",),
            np.array(FOCUS),
            {"units": "1", "long_name": "Noll coefficient c_4 added to the wavefront, in waves"},
        ),
        "shortcut": (
            ("shortcut",),
            np.array(SHORTCUTS, dtype=object),
            {"long_name": "how the exposure is approximated"},
        ),
    }
