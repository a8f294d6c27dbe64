"""Images of any optical system: exposures of its fields over what moves, in the light of all wavelengths.

The pupil of a field is where its rays go: the direction cosines of the image, onto which the system's pupil
is mapped linearly (`PreparedSystem.cosines`), so that a beam that is narrower across the field, or mirrored,
makes the image that it makes. All fields share one frame in mm, whose unit lambda/D is the primary
wavelength over twice the largest numerical aperture of all fields and colors. The phase is 2 pi OPD /
wavelength, the image the integral over exp(-2 pi i c x / wavelength) with direction cosines c
(docs/conventions.md); light that an opening stops at rest is dark, by the rays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.images.coherent import lit_by_cells, mean_image
from wavequake.chain.images.extended import ObjectSection, object_image
from wavequake.errors import UserError
from wavequake.imaging.engines.choice import PsfEngine, point_spread, prepare_psf
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.imaging.exposures.exposure_models import cut
from wavequake.imaging.pupils.nyquist import samples_for
from wavequake.imaging.pupils.outlines import Outline, annulus
from wavequake.imaging.pupils.pupil_function import PupilGrid, apodized, sampled_pupil
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.wavefronts.wavefront import PreparedSystem, SystemWavefront

Array = NDArray[np.float64]

# Of the perfect image's diameter, in lambda/D.
_UNIT_DIAMETER = 2.0
# What polygons that stand for circles reach beyond them.
_ROUND = 1.0 + 1e-6
# Images that are made at once: bounds the memory.
_BATCH = 16
# Frames across which incoherent light is followed, so that it moves in from outside of what is stored.
_CANVAS = 2


class SystemImagingSection(Section):
    """Exposures of every field point; lengths in lambda/D of the primary wavelength (docs/imaging.md)."""

    pixels: int = Field(default=64, ge=8, le=1024, description="of an exposure, along x and along y")
    sampling: float = Field(default=0.25, gt=0.0, le=0.5, description="width of a pixel, lambda/D")
    pupil_samples: int = Field(default=128, ge=16, le=2048, description="cells across the pupil")
    instants: int = Field(
        default=64,
        ge=1,
        le=100_000,
        description="of a case that are exposed, evenly spread",
    )
    weights: tuple[float, ...] | None = Field(
        default=None, strict=False, description="light of each wavelength; default: the same of all"
    )
    engine: Literal["auto", "matrix", "fft"] = Field(
        default="auto",
        description="Fourier transform: products for the wanted pixels alone, or a padded fast transform; "
        "auto takes the one with the least estimate",
    )

    @model_validator(mode="after")
    def _weights_are_light(self) -> "SystemImagingSection":
        if self.weights is not None and (
            min(self.weights, default=-1.0) < 0.0 or not sum(self.weights) > 0.0
        ):
            raise ValueError("weights are at least 0, and one is above 0")
        return self


@dataclass(frozen=True)
class FieldImager:
    """What makes the images of a field at one wavelength.

    Attributes
    ----------
    grid : PupilGrid
        In direction cosines over the largest numerical aperture of all fields.
    modes : ndarray, shape (m, J)
        Zernike polynomials of the system's pupil at the grid's patches.
    waves_per_mm : ndarray, shape (m, 2)
        Phase in waves at the patches for an image point that is 1 mm off.
    engine : PsfEngine
    """

    grid: PupilGrid
    modes: Array
    waves_per_mm: Array
    engine: PsfEngine


@dataclass(frozen=True)
class SystemImager:
    """What makes the exposures of a system.

    Attributes
    ----------
    section : SystemImagingSection
    imagers : tuple of tuple of FieldImager
        By field and wavelength.
    brightness : ndarray, shape (W,)
        What each wavelength adds to the perfect peak.
    primary : int
    resolution_mm : float
        lambda/D in the image: the primary wavelength over twice the largest numerical aperture.
    area : tuple of float
        Of each field's pupil, in units in which the diameter is 2.
    rest : ndarray, shape (F, 2)
        Line of sight at rest and the primary wavelength, mm: the middle of the frame.
    shown : ObjectSection, optional
    """

    section: SystemImagingSection
    imagers: tuple[tuple[FieldImager, ...], ...]
    brightness: Array
    primary: int
    resolution_mm: float
    area: tuple[float, ...]
    rest: Array
    shown: ObjectSection | None = None


def prepare_images(
    section: SystemImagingSection,
    prepared: Sequence[Sequence[PreparedSystem]],
    static: Sequence[Sequence[SystemWavefront]],
    lit: Mapping[tuple[int, int], NDArray[np.bool_]],
    shown: ObjectSection | None = None,
    device: Device = NUMPY,
) -> SystemImager:
    """Prepare the exposures of a system.

    Parameters
    ----------
    section : SystemImagingSection
    prepared, static : sequence of sequence
        By field and wavelength, what is traced and its wavefront at rest.
    lit : mapping
        By field and wavelength, which rays arrive at rest, bool (N,); nothing where all do.
    shown : ObjectSection, optional
        An extended object, whose image is made, too.
    device : Device
        Where the transforms run.

    Raises
    ------
    UserError
        If the weights do not fit the wavelengths, or the pupil's samples do not carry the wavefront at rest.
    """
    system, count = prepared[0][0].system, len(prepared[0])
    weights = np.array(section.weights if section.weights is not None else [1.0] * count)
    if len(weights) != count:
        raise UserError(
            f"imaging.weights has {len(weights)} for the {count} wavelengths of {system.name}; give one each."
        )
    primary = system.primary_wavelength
    aperture = _ROUND * max(
        one.image_index * float(np.linalg.svd(one.cosines, compute_uv=False)[0])
        for row in prepared
        for one in row
    )
    first = prepared[0][primary].wavelength
    relative = first / np.array([one.wavelength for one in prepared[0]])
    canvas = _CANVAS if shown is not None and shown.light == "incoherent" else 1
    imagers = tuple(
        tuple(
            _field_imager(section, one, aperture, float(factor), lit.get((field, index)), canvas, device)
            for index, (one, factor) in enumerate(zip(row, relative, strict=True))
        )
        for field, row in enumerate(prepared)
    )
    cell = (2.0 / section.pupil_samples) ** 2
    made = SystemImager(
        section,
        imagers,
        weights * relative**2 / float((weights * relative**2).sum()),
        primary,
        first / (_UNIT_DIAMETER * aperture),
        tuple(float(row[primary].grid.light.sum()) * cell for row in imagers),
        np.stack([row[primary].los[0] for row in static]),
        shown,
    )
    for field, row in enumerate(static):
        _require_samples(made, field, row)
    return made


def _field_imager(
    section: SystemImagingSection,
    prepared: PreparedSystem,
    aperture: float,
    relative: float,
    lit: NDArray[np.bool_] | None,
    canvas: int,
    device: Device,
) -> FieldImager:
    to_pupil = np.linalg.inv(prepared.image_index * prepared.cosines / aperture)
    grid = _mapped_pupil(prepared, aperture, section.pupil_samples)
    x, y = to_pupil @ np.stack([grid.x, grid.y])
    if lit is not None and not lit.all():
        grid = apodized(grid, _seen_light(prepared, lit, x, y))
    terms = prepared.fit.basis.shape[1]
    sampling = section.sampling * relative
    pixels = canvas * section.pixels
    return FieldImager(
        grid,
        annular_zernike(x, y, terms, prepared.system.pupil.obscuration),
        np.stack([grid.x, grid.y], axis=1) * (aperture / prepared.wavelength),
        prepare_psf(grid, pixels, sampling, section.engine, device),
    )


def _mapped_pupil(prepared: PreparedSystem, aperture: float, samples: int) -> PupilGrid:
    """Return the pupil in direction cosines over an aperture: the annulus as the field's beam shows it."""
    ring = annulus(1.0, prepared.system.pupil.obscuration)
    to_cosines = prepared.image_index * prepared.cosines / aperture
    corners = ring.corners @ to_cosines.T
    if np.linalg.det(to_cosines) < 0.0:
        corners = corners[:, ::-1]  # mirrored: counter-clockwise all the same
    return sampled_pupil(Outline(corners, ring.sign, ring.piece), samples, _UNIT_DIAMETER)


def _seen_light(prepared: PreparedSystem, lit: NDArray[np.bool_], x: Array, y: Array) -> Array:
    """Return 1 at the places whose nearest ray arrives at rest, else 0."""
    from scipy.spatial import cKDTree  # slow to import, and few systems vignette

    _, nearest = cKDTree(prepared.pupil).query(np.stack([x, y], axis=1))
    return np.asarray(lit[nearest], dtype=np.float64)


def _require_samples(imager: SystemImager, field: int, static: Sequence[SystemWavefront]) -> None:
    section = imager.section
    for index, wavefront in enumerate(static):
        one = imager.imagers[field][index]
        phase = 2.0 * np.pi * _phases(imager, field, index, wavefront.zernike, wavefront.los)
        width = _CANVAS * section.pixels * section.sampling
        needed = samples_for(one.grid, phase, width)
        if needed > section.pupil_samples:
            raise UserError(
                f"imaging.pupil_samples is {section.pupil_samples}, but the wavefront at rest and a frame of "
                f"{section.pixels} pixels need {needed}; set it to at least that, or take fewer pixels."
            )


def _phases(imager: SystemImager, field: int, wavelength: int, zernike: Array, los: Array) -> Array:
    """Return phases (T, m) in waves: figures as fitted, the place of the image by the line of sight."""
    one = imager.imagers[field][wavelength]
    shape = np.array(zernike)
    shape[:, :3] = 0.0  # piston makes no image, and tilt is the line of sight
    return np.asarray(shape @ one.modes.T + (los - imager.rest[field]) @ one.waves_per_mm.T)


def exposed_instants(section: SystemImagingSection, instants: int) -> NDArray[np.intp]:
    """Return which of the instants of a case are exposed, evenly spread."""
    chosen = np.linspace(0, instants - 1, min(section.instants, instants)).round()
    return np.unique(chosen.astype(np.intp))


def expose(imager: SystemImager, field: int, wavefronts: Sequence[SystemWavefront]) -> dict[str, Array]:
    """Return exposure, its peak and radii, of a field over the instants of its wavefronts.

    Parameters
    ----------
    imager : SystemImager
    field : int
    wavefronts : sequence of SystemWavefront
        By wavelength, of T instants each.

    Returns
    -------
    dict of str to ndarray
        ``exposure`` (y, x) relative to the perfect peak, ``peak``, ``ee50`` and ``ee80`` (lambda/D), and
        ``object_image`` (y, x) where there is an object.
    """
    section = imager.section
    chosen = exposed_instants(section, len(wavefronts[0].los))
    total = np.zeros(())
    for index, (wavefront, share) in enumerate(zip(wavefronts, imager.brightness, strict=True)):
        if not share:
            continue
        engine = imager.imagers[field][index].engine
        images = np.zeros(())
        for first in range(0, len(chosen), _BATCH):
            part = chosen[first : first + _BATCH]
            phase = _phases(imager, field, index, wavefront.zernike[part], wavefront.los[part])
            images = images + point_spread(engine, 2.0 * np.pi * phase, check=False).sum(axis=0)
        total = total + share * images / len(chosen)
    exposure = cut(total, section.pixels)
    size = section.sampling, imager.area[field], _UNIT_DIAMETER
    found = {
        "exposure": exposure,
        "peak": np.asarray(exposure.max()),
        **dict(zip(("ee50", "ee80"), encircled_energy_radius(exposure, (0.5, 0.8), *size), strict=True)),
    }
    if imager.shown is not None:
        found["object_image"] = _seen_object(imager, field, total, wavefronts[imager.primary], chosen)
    return found


def _seen_object(
    imager: SystemImager, field: int, canvas: Array, wavefront: SystemWavefront, chosen: NDArray[np.intp]
) -> Array:
    """Return the image of the object: by the exposure in incoherent light, else instant by instant."""
    section, shown = imager.section, imager.shown
    assert shown is not None
    if shown.light == "incoherent":
        return object_image(
            shown, canvas, section.pixels, section.sampling, imager.area[field], _UNIT_DIAMETER
        )
    one = imager.imagers[field][imager.primary]
    lit = lit_by_cells(shown, one.engine.transform)
    phases = _phases(imager, field, imager.primary, wavefront.zernike[chosen], wavefront.los[chosen])
    return mean_image(lit, [phases])


def on_device(imager: SystemImager, device: Device) -> SystemImager:
    """Return the same with transforms on another device."""
    rows = tuple(
        tuple(
            replace(
                one,
                engine=prepare_psf(
                    one.grid,
                    len(one.engine.transform.axis),
                    float(one.engine.transform.axis[1] - one.engine.transform.axis[0]),
                    one.engine.name,
                    device,
                ),
            )
            for one in row
        )
        for row in imager.imagers
    )
    return replace(imager, imagers=rows)
