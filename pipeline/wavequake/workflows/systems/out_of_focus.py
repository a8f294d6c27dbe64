"""Optics whose image lies far from their focus: first-order optics and a ray say so before anything else."""

from collections.abc import Iterator
from dataclasses import replace
from math import isfinite, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.errors import UserError

if TYPE_CHECKING:
    from wavequake.workflows.segments.study import SegmentStudy

_SPHERICAL = 1.0 / (
    6.0 * sqrt(5.0)
)  # rms at the paraxial focus over the rim's transverse aberration times NA
_FAR, _IMAGELESS = 10.0, 100.0  # waves rms: of no design, and of none whose segments have an image


def out_of_focus(study: Study) -> Iterator[str]:
    """Yield a sentence if the image of a study's telescope or system is far from its paraxial focus."""
    waves, words = _defocus(study)
    if waves > _FAR:
        yield f"warning: {words} ({waves:.3g} waves rms)."


def require_focus(study: "SegmentStudy") -> None:
    """Raise UserError if images are asked of a telescope of one's own that is too far from focus for any.

    Those nearer are told when all is prepared, by the whole wavefront.
    """
    if not study.imaging.enabled or study.telescope.name != "custom":
        return
    waves, words = _defocus(study)
    if waves > _IMAGELESS:
        raise UserError(
            f"The telescope at rest is too far from focus for an image (by {waves:.3g} waves rms): {words}."
        )


def _defocus(study: Any) -> tuple[float, str]:
    """Return how far a study's optics are out of focus, waves rms, and in words; 0 where nobody knows."""
    try:
        if getattr(study, "telescope", None) is not None:
            return _of_telescope(study)
        if getattr(study, "system", None) is not None:
            return _of_system(study)
    except UserError:  # what is wrong there is said with what is prepared
        pass
    return 0.0, ""


def _of_telescope(study: Any) -> tuple[float, str]:
    from wavequake.optics.segments.telescope import first_order, rim_aberration
    from wavequake.optics.systems.system import wavelength_of
    from wavequake.workflows.segments.bench import build_telescope

    system = build_telescope(study)
    if hasattr(study, "optics"):
        system = replace(system, wavelengths=np.array([study.optics.wavelength_nm * 1e-6]))
    optics, (*_, last, image) = first_order(system), ("M1", *(one.name for one in system.after_primary))
    waves = waves_of_defocus(optics.defocus, optics.numerical_aperture, wavelength_of(system))
    if waves > _FAR:
        return waves, place_of_image(image, last, optics.defocus, optics.back_focus)
    beside = rim_aberration(system)
    return (
        _SPHERICAL * beside * optics.numerical_aperture / wavelength_of(system),
        f"axial rays of M1's rim meet {image} {beside:.3g} mm beside those of its center; mend a conic",
    )


def _of_system(study: Any) -> tuple[float, str]:
    from wavequake.optics.systems.file import build
    from wavequake.optics.systems.paraxial import paraxial
    from wavequake.optics.systems.system import wavelength_of

    system = build(study.system)
    optics, (*_, last, image) = paraxial(system), [one.name for one in system.after_primary]
    if not isfinite(optics.defocus):
        return 0.0, ""
    return (
        waves_of_defocus(optics.defocus, optics.image_na, float(wavelength_of(system))),
        place_of_image(image, last, optics.defocus, optics.image_distance),
    )


def waves_of_defocus(defocus: float, aperture: float, wavelength: float) -> float:
    """Return the rms wavefront error of an image plane beside the focus, over a full pupil, in waves."""
    return abs(defocus) * aperture**2 / (4.0 * sqrt(3.0)) / wavelength


def place_of_image(image: str, last: str, defocus: float, back_focus: float) -> str:
    """Say where an image plane stands, by distances in mm along the light, and what may be wrong."""
    side = "beyond" if defocus > 0.0 else "before"
    return (
        f"{image} stands {abs(defocus):.6g} mm {side} the paraxial focus, which is {back_focus:.8g} mm "
        f"behind {last}; mend a distance_mm or a radius"
    )
