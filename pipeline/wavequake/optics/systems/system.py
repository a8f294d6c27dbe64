"""Any sequential optical system: surfaces, stop, pupil, fields and wavelengths. Lengths in mm, angles in rad.

The z axis runs along the incoming light and keeps its sense after a reflection, as in Table 4.2 of Störkle
2018: a surface that follows an odd number of mirrors stands at smaller z.
"""

from dataclasses import dataclass, field, replace
from typing import Literal
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.checks import number, require_fields, require_kind
from wavequake.optics.media.glasses import AIR, Medium
from wavequake.optics.media.gradients import GradientIndex, require_gradient
from wavequake.optics.segments.layout import Segments
from wavequake.optics.shapes.phases import Effect, PerfectLens, require_effect
from wavequake.optics.shapes.sag import require_shape
from wavequake.optics.shapes.shapes import (
    Conic,
    Deformation,
    Opening,
    Shape,
    SurfaceAction,
    ZernikeDeformation,
)
from wavequake.optics.systems.apodization import Apodization, require_apodization
from wavequake.words import counted

Array = NDArray[np.float64]

_WIDE = np.deg2rad(85.0)  # where light hardly crosses a plane that is upright to the axis
_SMALLEST, LARGEST = 1e-9, 1e12  # apertures and distances, mm: products of some of them do not overflow


@dataclass(frozen=True)
class Surface:
    """One surface: its shape, where its vertex stands (3,), how it is turned (3, 3), and what it does.

    ``rotation`` turns the surface's frame into the system's. ``medium`` follows a refracting surface; one
    with a gradient starts at its vertex and moves with it. A ``phase`` diffracts or focuses light, whatever
    the action is. A mirror may carry ``segments``, which move by themselves; ``body`` names what it
    moves with.
    """

    name: str
    shape: Shape = field(default_factory=Conic)
    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))
    action: SurfaceAction = "pass"
    medium: Medium | GradientIndex = AIR
    opening: Opening | None = None
    deformation: Deformation | None = None
    phase: Effect | None = None
    segments: Segments | None = None
    body: str = ""


@dataclass(frozen=True)
class Pupil:
    """How wide the beam is: one number, of the kind that the system is specified by.

    "entrance_diameter" (mm), "image_na", "object_na", "f_number" (paraxial image-space), or "stop" (the stop
    surface's opening limits the beam; ``value`` is its radius in mm). ``obscuration`` is the inner radius as
    a fraction of the outer. Without an ``apodization`` the light is uniform.
    """

    kind: Literal["entrance_diameter", "image_na", "object_na", "f_number", "stop"]
    value: float
    obscuration: float = 0.0
    apodization: Apodization | None = None


@dataclass(frozen=True, repr=False)
class OpticalSystem:
    """A sequential system; the last surface is the image.

    Attributes
    ----------
    name : str
    surfaces : tuple of Surface
    stop : int
        Index of the surface that is the aperture stop.
    pupil : Pupil
    object_distance : float
        From the object plane to the first surface's vertex; infinite for a star.
    fields : ndarray, shape (F, 2)
        Angles for an infinite object (see `field_direction`), heights in mm for a finite one.
    wavelengths : ndarray, shape (W,)
        mm.
    primary_wavelength : int
    telecentric : bool
        The entrance pupil is at infinity: chief rays leave a finite object parallel to the axis.
    medium : Medium
        Before the first surface.
    note : str
        Which of its numbers are assumed or approximate, in a sentence; `wavequake.info` shows it.
    vignetting : tuple of 5 float for each field, or empty
        Which part of the stop the light of each field fills, seen from the object, for lack of the
        apertures that stop the rest: x and y of its center, one minus its half widths (all in units of the
        stop's radius), and how far the ellipse is turned (rad).
    """

    name: str
    surfaces: tuple[Surface, ...]
    stop: int
    pupil: Pupil
    object_distance: float = np.inf
    fields: Array = field(default_factory=lambda: np.zeros((1, 2)))
    wavelengths: Array = field(default_factory=lambda: np.array([550e-6]))
    primary_wavelength: int = 0
    telecentric: bool = False
    medium: Medium = AIR
    note: str = ""
    vignetting: tuple[tuple[float, float, float, float, float], ...] = ()

    def __repr__(self) -> str:
        segments = () if self.segmented is None else (counted(len(self.segments), "segment"),)
        parts = (
            *segments,
            counted(len(self.surfaces), "surface"),
            counted(len(self.fields), "field"),
            counted(len(self.wavelengths), "wavelength"),
        )
        return f"<OpticalSystem {self.name}: {', '.join(parts)}>"

    @property
    def segmented(self) -> int | None:
        """Index of the surface that carries segments, if there is one."""
        return next((place for place, one in enumerate(self.surfaces) if one.segments is not None), None)

    @property
    def primary(self) -> Surface:
        """The surface that carries segments, M1; UserError if there is none."""
        if self.segmented is None:
            raise UserError(f"no surface of {self.name} carries segments, as M1 of telescope('tmt') does")
        return self.surfaces[self.segmented]

    @property
    def segments(self) -> Segments:
        """Those of M1; raises as `primary`."""
        segments = self.primary.segments
        assert segments is not None
        return segments

    @property
    def after_primary(self) -> tuple[Surface, ...]:
        """M2, M3, ... and the image; all where no surface carries segments."""
        return self.surfaces[0 if self.segmented is None else self.segmented + 1 :]

    @property
    def annulus(self) -> Opening:
        """The opening of the stop; UserError if it has none."""
        opening = self.surfaces[self.stop].opening
        if opening is None:
            raise UserError(f"the stop of {self.name} has no opening; a pupil's annulus needs one")
        return opening

    @property
    def stop_z(self) -> float:
        """Where on the z axis the stop stands, mm."""
        return float(self.surfaces[self.stop].position[2])

    @property
    def bodies(self) -> dict[str, tuple[str, ...]]:
        """Surfaces that can move together, such as the faces of a lens, by the name of what they are."""
        names = dict.fromkeys(one.body for one in self.surfaces if one.body)
        return {name: tuple(one.name for one in self.surfaces if one.body == name) for name in names}


def with_surface(system: OpticalSystem, index: int, surface: Surface) -> OpticalSystem:
    """Return the system with another surface in one place."""
    return replace(system, surfaces=(*system.surfaces[:index], surface, *system.surfaces[index + 1 :]))


def wavelength_of(system: OpticalSystem, wavelength: float | None = None) -> float:
    """Return a wavelength in mm: the one that is given, or else the primary one of the system.

    Raises
    ------
    UserError
        If the system has no such wavelength.
    """
    if wavelength is not None:
        return number(wavelength, "the wavelength")
    if not 0 <= system.primary_wavelength < len(system.wavelengths):
        raise UserError(
            f"the primary wavelength of {system.name} is number {system.primary_wavelength}, counted from 0; "
            f"it has {len(system.wavelengths)}"
        )
    return float(system.wavelengths[system.primary_wavelength])


_ONE = np.eye(3)
_NEAR_ONE = 1e-9 + 1e-5 * _ONE  # off it are rotations by rounding

# Systems whose fields are known to hold what they should: looking takes as long as a small trace.
_OF_RIGHT_KIND: WeakValueDictionary[int, OpticalSystem] = WeakValueDictionary()


def require_system(system: OpticalSystem) -> None:
    """Check a system before anything is computed from it.

    Raises
    ------
    UserError
        If an index, shape or number is out of range or of another kind; the message names the surface.
    """
    if id(system) not in _OF_RIGHT_KIND:
        hint = ", such as load_system('double-gauss') returns"
        require_kind(system, OpticalSystem, "the system", hint)
        require_fields(system, f"the system {system.name}")
        _OF_RIGHT_KIND[id(system)] = system
    count, name = len(system.surfaces), system.name
    if count == 0:
        raise UserError(f"the system {name} has no surfaces; it needs at least an image plane")
    if not 0 <= system.stop < count:
        raise UserError(
            f"the stop of {name} is surface {system.stop}; it must be one of its surfaces 0 to {count - 1}"
        )
    if 0 < system.stop == count - 1:
        raise UserError(
            f"the stop of {name} is its image, which leaves no exit pupil; choose another surface"
        )
    wavelength_of(system)
    waves = np.asarray(system.wavelengths)
    if not ((waves >= _SMALLEST) & (waves <= LARGEST)).all():
        raise UserError(
            f"the wavelengths of {name} must be positive numbers in mm, from {_SMALLEST:g} to {LARGEST:g}"
        )
    if system.fields.ndim != 2 or system.fields.shape[1:] != (2,) or not np.isfinite(system.fields).all():
        raise UserError(f"the fields of {name} must be an array (fields, 2) of finite numbers")
    if not len(system.fields):
        raise UserError(f"{name} has no field; the axis is the field (0, 0)")
    if system.vignetting and len(system.vignetting) != len(system.fields):
        raise UserError(f"the vignetting of {name} must hold five numbers for each of its fields")
    if np.isnan(system.object_distance):
        raise UserError(f"the object distance of {name} is not a number; a star's is infinite")
    if np.isinf(system.object_distance) and system.telecentric:
        raise UserError(
            f"{name} is telecentric in the object space, where its object is at infinity; give the object a "
            "finite distance"
        )
    if np.isinf(system.object_distance):
        beyond = np.abs(system.fields) >= np.pi / 2.0
        if beyond.all(axis=1).any() or not (np.abs(system.fields) < np.pi).all():
            raise UserError(
                f"a field of {name} lies 90 degrees or more off the axis along both x and y, or 180 along "
                "one; its light does not come in"
            )
    _require_pupil(system)
    medium: Medium | GradientIndex = system.medium
    for surface in system.surfaces:
        _require_surface(name, surface)
        medium = surface.medium if surface.action == "refract" else medium
    if isinstance(medium, GradientIndex):
        raise UserError(
            f"the image of {name} lies in the medium {medium.name}, whose index varies; add a refracting "
            "surface that ends it (at no distance from the image, if need be)"
        )
    if system.surfaces[-1].phase is not None:
        raise UserError(
            f"the last surface of {name}, {system.surfaces[-1].name}, is the image: it cannot have a phase"
        )
    if system.surfaces[-1].action != "pass":
        raise UserError(
            f"the last surface of {name}, {surface.name}, is the image: its action must be 'pass', "
            f"not {surface.action!r}"
        )


def _require_pupil(system: OpticalSystem) -> None:
    pupil = system.pupil
    if not _SMALLEST <= pupil.value <= LARGEST:
        raise UserError(
            f"the {pupil.kind} of {system.name} is {pupil.value}; it must be positive, from {_SMALLEST:g} to "
            f"{LARGEST:g}"
        )
    if not 0.0 <= pupil.obscuration < 1.0:
        raise UserError(
            f"the pupil of {system.name} is obscured to {pupil.obscuration} of its radius; light passes "
            "where that is at least 0 and less than 1"
        )
    if pupil.apodization is not None:
        require_apodization(pupil.apodization, system.name)
        if system.segmented is not None:
            raise UserError(
                f"the pupil of {system.name} is apodized, but the images of segments are of uniform light"
            )


def _require_surface(system: str, surface: Surface) -> None:
    where = f"the surface {surface.name} of {system}"
    try:
        require_shape(surface.shape)
        require_effect(surface.phase)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    _require_deformation(where, surface.deformation)
    if isinstance(surface.phase, PerfectLens):
        flat = surface.shape == Conic() and surface.deformation is None
        if not flat or surface.action == "reflect":
            raise UserError(
                f"{where} is a perfect lens; it must be a plane that neither reflects nor deforms"
            )
    if surface.position.shape != (3,) or not (np.abs(surface.position) <= LARGEST).all():
        raise UserError(f"the position of {where} must be 3 finite numbers, of at most {LARGEST:g} mm")
    turn = surface.rotation
    if (
        turn.shape != (3, 3)
        or not (np.abs(turn @ turn.T - _ONE) <= _NEAR_ONE).all()
        or np.linalg.det(turn) < 0
    ):
        raise UserError(f"the rotation of {where} must be a rotation matrix (3, 3)")
    if surface.action not in ("reflect", "refract", "pass"):
        raise UserError(f"{where} does {surface.action!r}; it can reflect, refract or pass")
    if isinstance(surface.medium, GradientIndex):
        try:
            require_gradient(surface.medium)
        except UserError as error:
            raise UserError(f"{where}: {error}") from error
    opening = surface.opening
    if opening is not None and not 0.0 <= opening.inner < opening.outer:
        raise UserError(
            f"the opening of {where} reaches from radius {opening.inner:g} to {opening.outer:g} mm; it needs "
            "0 <= inner < outer"
        )


def _require_deformation(where: str, form: Deformation | None) -> None:
    if isinstance(form, ZernikeDeformation):
        if not (form.terms >= 1 and np.isfinite(form.pupil_radius) and form.pupil_radius > 0.0):
            raise UserError(
                f"{where} deforms by {form.terms} Zernike terms over a radius of {form.pupil_radius} mm; it "
                "needs at least 1 term and a positive radius"
            )
        if not 0.0 <= form.obscuration < 1.0:
            raise UserError(f"{where} deforms over an annulus of {form.obscuration}; it must lie in [0, 1)")
        form = form.residual
    if form is not None and not (min(form.rows, form.columns) >= 4 and form.dx > 0.0 and form.dy > 0.0):
        raise UserError(
            f"{where} deforms on a grid of {form.rows} rows and {form.columns} columns, {form.dx} and "
            f"{form.dy} mm apart; it needs at least 4 of each and positive spacings"
        )


def is_wide(fields: Array) -> bool:
    """Tell whether light of a field at infinity comes from the side or from behind, from 85 degrees on."""
    return bool((np.abs(fields) >= _WIDE).any())


def field_direction(field: Array) -> Array:
    """Return the direction (3,) of light of a field (2,) at infinity: tan of the angles are its slopes.

    From 90 degrees on, light goes on turning: that of (0, 100) degrees runs along +y and a little along -z.
    """
    if is_wide(field):
        (sine_x, sine_y), (cosine_x, cosine_y) = np.sin(field), np.cos(field)
        direction = np.array([sine_x * cosine_y, cosine_x * sine_y, cosine_x * cosine_y])
    else:
        direction = np.array([*np.tan(field), 1.0])
    return np.asarray(direction / np.linalg.norm(direction))


@dataclass(frozen=True)
class States:
    """What moves and deforms at T instants; zeros are the system at rest.

    Attributes
    ----------
    surface_motion : ndarray, shape (T, L, 6)
        Displacement along and rotation about the axes of each surface's own frame at rest (mm, rad), Cardan
        angles x-y-z about its vertex.
    deformations : tuple of (ndarray or None), one per surface
        (T, terms) Noll coefficients, followed by the heights of their residual grid where there is one, or
        (T, rows, columns) grid heights; mm, along the surface's z.
    line_of_sight : ndarray, shape (T, 2)
        Rotation of the whole incoming bundle, as an angle on the sky along x and y, rad.
    segment_motion : ndarray, shape (T, S, 6)
        The same of each segment in its local frame (dz along the normal that points to the sky), about its
        center.
    segment_figure : ndarray, shape (T, S, terms)
        Circular Noll coefficients, j = 1 and up, over each segment's circumscribed circle in its local frame;
        mm, positive towards the sky.
    """

    surface_motion: Array
    deformations: tuple[Array | None, ...]
    line_of_sight: Array
    segment_motion: Array = field(default_factory=lambda: np.zeros((0, 0, 6)))
    segment_figure: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def __len__(self) -> int:
        return len(self.line_of_sight)
