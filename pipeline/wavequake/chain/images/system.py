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

from wavequake.chain.images.camera import Camera, DetectorSection, SharedImagingSection, require_pixels
from wavequake.chain.images.coherent import lit_by_cells, mean_image, smeared_object
from wavequake.chain.images.extended import ObjectSection, object_image
from wavequake.chain.images.field_pupil import UNIT_DIAMETER, defocus, mapped_pupil, with_light
from wavequake.chain.images.streak import leaves_dots
from wavequake.errors import UserError
from wavequake.imaging.engines.choice import PsfEngine, point_spread, prepare_psf
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.imaging.exposures.exposure_models import cut
from wavequake.imaging.exposures.smear import add_smeared, empty_total, smeared_image
from wavequake.imaging.pupils.nyquist import samples_for
from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.optics.wavefronts.wavefront import PreparedSystem

Array = NDArray[np.float64]

# What polygons that stand for circles reach beyond them.
_ROUND = 1.0 + 1e-6
# Images that are made at once: bounds the memory.
_BATCH = 16
# Frames across which incoherent light is followed, so that it moves in from outside of what is stored.
_CANVAS = 2


class SystemImagingSection(SharedImagingSection):
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
    defocus : ndarray, shape (K, m)
        Phase in waves in each of the planes through focus.
    cells : float
        So many cells of the grid, evenly lit, bring as much light under as high a peak.
    """

    grid: PupilGrid
    modes: Array
    waves_per_mm: Array
    engine: PsfEngine
    defocus: Array
    cells: float


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
        Of the pupil of each field in which the primary wavelength alone would bring as much light under the
        perfect peak as all colors do, in units in which the diameter is 2.
    rest : ndarray, shape (F, 2)
        Line of sight at rest and the primary wavelength, mm: the middle of the frame.
    shown : ObjectSection, optional
    detector : DetectorSection, optional
    """

    section: SystemImagingSection
    imagers: tuple[tuple[FieldImager, ...], ...]
    brightness: Array
    primary: int
    resolution_mm: float
    area: tuple[float, ...]
    rest: Array
    shown: ObjectSection | None = None
    detector: DetectorSection | None = None

    @property
    def camera(self) -> Camera:
        """What makes numbers of the exposures."""
        one = self.section
        size = self.area, UNIT_DIAMETER, self.resolution_mm
        return Camera(one.pixels, one.sampling, *size, one.resolution, self.detector)


def prepare_images(
    section: SystemImagingSection,
    prepared: Sequence[Sequence[PreparedSystem]],
    static: Sequence[Sequence[Wavefront]],
    lit: Mapping[tuple[int, int], NDArray[np.bool_]],
    shown: ObjectSection | None = None,
    detector: DetectorSection | None = None,
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
    detector : DetectorSection, optional
        What counts photons.
    device : Device
        Where the transforms run.

    Raises
    ------
    UserError
        If the weights do not fit the wavelengths, the pupil's samples do not carry the wavefront at rest, or
        the detector's pixels do not suit the frame.
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
    # Shorter waves bring more light under the same peak: that much larger a pupil of the primary one seems.
    cell = (2.0 / section.pupil_samples) ** 2 * float((weights * relative**2).sum() / weights.sum())
    made = SystemImager(
        section,
        imagers,
        weights * relative**2 / float((weights * relative**2).sum()),
        primary,
        first / (UNIT_DIAMETER * aperture),
        tuple(row[primary].cells * cell for row in imagers),
        np.stack([row[primary].los[0] for row in static]),
        shown,
        detector,
    )
    require_pixels(made.camera)
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
    grid = mapped_pupil(prepared, aperture, section.pupil_samples)
    x, y = to_pupil @ np.stack([grid.x, grid.y])
    grid, cells = with_light(prepared, grid, x, y, lit)
    terms = prepared.fit.basis.shape[1]
    return FieldImager(
        grid,
        annular_zernike(x, y, terms, prepared.system.pupil.obscuration),
        np.stack([grid.x, grid.y], axis=1) * (aperture / prepared.wavelength),
        prepare_psf(grid, canvas * section.pixels, section.sampling * relative, section.engine, device),
        defocus(prepared, np.stack([grid.x, grid.y], axis=1) * aperture, section.focus_um),
        cells,
    )


def _require_samples(imager: SystemImager, field: int, static: Sequence[Wavefront]) -> None:
    section = imager.section
    for index, wavefront in enumerate(static):
        one = imager.imagers[field][index]
        at_rest = _phases(imager, field, index, wavefront.zernike, wavefront.los)
        phase = 2.0 * np.pi * np.concatenate([at_rest, at_rest + one.defocus])
        width = _CANVAS * section.pixels * section.sampling
        needed = samples_for(one.grid, phase, width)
        if needed > section.pupil_samples:
            raise UserError(
                f"imaging.pupil_samples is {section.pupil_samples}, but the wavefront at rest"
                f"{', imaging.focus_um' if section.focus_um else ''} and a frame of {section.pixels} pixels "
                f"need {needed}; set it to at least that, or take fewer pixels."
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


def expose(
    imager: SystemImager, field: int, wavefronts: Sequence[Wavefront], away_mm: Array | None = None
) -> dict[str, Array]:
    """Return exposure, its peak and radii, of a field over the instants of its wavefronts.

    Parameters
    ----------
    imager : SystemImager
    field : int
    wavefronts : sequence of Wavefront
        By wavelength, of T instants each.
    away_mm : ndarray, shape (exposed instants, m, 2), optional
        Where the line of sight is besides, from where each exposed instant has it: what is exposed there
        looks as at that instant.

    Returns
    -------
    dict of str to ndarray
        ``exposure`` (y, x) relative to the perfect peak, ``peak``, ``ee50`` and ``ee80`` (lambda/D),
        ``exposure_focus`` (K, y, x) in planes behind the image, and ``object_image`` (y, x) where there is
        an object.
    """
    section = imager.section
    chosen = exposed_instants(section, len(wavefronts[0].los))
    away = None if away_mm is None else away_mm / imager.resolution_mm
    if away is not None and leaves_dots(away):
        imager = _with_margin(imager, field, float(np.abs(away).max()))
    else:
        away = None
    total, *through = (
        _exposed(imager, field, wavefronts, chosen, plane, away)
        for plane in (None, *range(len(section.focus_um)))
    )
    exposure = cut(total, section.pixels)
    size = section.sampling, imager.area[field], UNIT_DIAMETER
    found = {
        "exposure": exposure,
        "peak": np.asarray(exposure.max()),
        **dict(zip(("ee50", "ee80"), encircled_energy_radius(exposure, (0.5, 0.8), *size), strict=True)),
    }
    if through:
        found["exposure_focus"] = np.stack([cut(one, section.pixels) for one in through])
    if imager.shown is not None:
        found["object_image"] = _seen_object(imager, field, total, wavefronts[imager.primary], chosen, away)
    return found


def _exposed(
    imager: SystemImager,
    field: int,
    wavefronts: Sequence[Wavefront],
    chosen: NDArray[np.intp],
    plane: int | None,
    away: Array | None,
) -> Array:
    """Return the exposure in all colors on the engine's canvas, in the image or in a plane behind it.

    Each instant's image moves by ``away`` (instants, m, 2) in lambda/D, if any.
    """
    total, size = np.zeros(()), len(imager.imagers[field][imager.primary].engine.transform.axis)
    smeared = None if away is None else empty_total(size, away, imager.section.sampling)
    for index, (wavefront, share) in enumerate(zip(wavefronts, imager.brightness, strict=True)):
        if not share:
            continue
        one, images = imager.imagers[field][index], np.zeros(())
        for first in range(0, len(chosen), _BATCH):
            part = chosen[first : first + _BATCH]
            phase = _phases(imager, field, index, wavefront.zernike[part], wavefront.los[part])
            if plane is not None:
                phase = phase + one.defocus[plane]
            frames = point_spread(one.engine, 2.0 * np.pi * phase, check=False)
            if smeared is not None and away is not None:
                add_smeared(smeared, share * frames, away[first : first + _BATCH], imager.section.sampling)
            else:
                images = images + frames.sum(axis=0)
        total = total + share * images / len(chosen)
    if smeared is not None and away is not None:
        return smeared_image(smeared, away, size, imager.section.sampling)
    return total


def _with_margin(imager: SystemImager, field: int, reach: float) -> SystemImager:
    """Return the same with images of a field from whose margin light moves into the frame, `reach` away.

    They are at most as wide as pupils are sampled for.
    """
    section, before = imager.section, len(imager.imagers[field][imager.primary].engine.transform.axis)
    wanted = section.pixels + 2 * int(np.ceil(reach / section.sampling))
    pixels = max(before, min(8 * -(-wanted // 8), _CANVAS * section.pixels))
    row = tuple(_with_pixels(one, pixels, one.engine.device) for one in imager.imagers[field])
    return replace(imager, imagers=(*imager.imagers[:field], row, *imager.imagers[field + 1 :]))


def _seen_object(
    imager: SystemImager,
    field: int,
    canvas: Array,
    wavefront: Wavefront,
    chosen: NDArray[np.intp],
    away: Array | None,
) -> Array:
    """Return the image of the object: by the exposure in incoherent light, else instant by instant."""
    section, shown = imager.section, imager.shown
    assert shown is not None
    if shown.light == "incoherent":
        return object_image(
            shown, canvas, section.pixels, section.sampling, imager.area[field], UNIT_DIAMETER
        )
    one = imager.imagers[field][imager.primary]
    lit = lit_by_cells(shown, one.engine.transform, section.pixels)
    phases = _phases(imager, field, imager.primary, wavefront.zernike[chosen], wavefront.los[chosen])
    if away is None:
        return cut(mean_image(lit, [phases]), section.pixels)
    return cut(smeared_object(lit, phases, away, section.sampling), section.pixels)


def on_device(imager: SystemImager, device: Device) -> SystemImager:
    """Return the same with transforms on another device."""
    rows = tuple(
        tuple(_with_pixels(one, len(one.engine.transform.axis), device) for one in row)
        for row in imager.imagers
    )
    return replace(imager, imagers=rows)


def _with_pixels(one: FieldImager, pixels: int, device: Device) -> FieldImager:
    """Return the same with images of so many pixels, transformed on a device."""
    axis = one.engine.transform.axis
    engine = prepare_psf(one.grid, pixels, float(axis[1] - axis[0]), one.engine.name, device)
    return replace(one, engine=engine)
