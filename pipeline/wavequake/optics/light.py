"""The wavefronts of any system in any state: packing chooses the kernel.

Systems whose M1 carries segments are traced by the kernel for segments where that can express what there is;
else the sequential kernel traces the light of each segment, through the parent of M1 where the segment takes
it. A ray that leaves the glass of its segment is lost there; the other kernel looks for another segment.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.kernels.device.tiles import from_tiles, padded
from wavequake.kernels.sums.opd import path_differences
from wavequake.kernels.trace.sequence import Rays, TracedRays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import GAP, VIGNETTED
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.rays.packing import pack
from wavequake.optics.rays.pupils import PupilRays, on_glass, segment_rays, sunflower
from wavequake.optics.segments.kinematics import cardan, cardan_angles, segment_poses
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.prepared import at_field, prepare
from wavequake.optics.segments.telescope import M2, with_figures
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening
from wavequake.optics.systems.kinematics import joined, rest_states
from wavequake.optics.systems.system import (
    OpticalSystem,
    States,
    Surface,
    require_system,
    wavelength_of,
    with_surface,
)
from wavequake.optics.wavefronts.record import ARRAYS, Wavefront
from wavequake.optics.wavefronts.wavefront import (
    about_chief,
    analyse_system,
    chief_points,
    incoming_light,
    measure_system,
    prepare_system,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Light:
    """Which light is traced, and how many polynomials describe its wavefront."""

    rays: PupilRays
    terms: int
    field: int
    wavelength: float


def trace(
    system: OpticalSystem,
    states: States | None = None,
    *,
    rays: int = 1000,
    terms: int = 15,
    field: int = 0,
    wavelength: float | None = None,
    device: str = "auto",
) -> Wavefront:
    """Trace a system, with or without segments, at all instants of its states.

    Parameters
    ----------
    system : OpticalSystem
    states : States, optional
        T instants; one at rest by default.
    rays : int
        That are spread evenly over the pupil, or of segments the least number: they have 6 triangles and more
        with the same points of a cubature in each.
    terms : int
        Number of Noll Zernike polynomials.
    field : int
        Index of the field point.
    wavelength : float, optional
        mm; the system's primary one by default.
    device : str
        As `campaign.device`.

    Raises
    ------
    UserError
        If the states do not fit the system, light does not arrive, or segments deform where only the
        sequential kernel can trace what follows them.

    Examples
    --------
    >>> wq.trace(wq.telescope("tmt-18"), rays=100).lost  # doctest: +SKIP
    array([0])
    """
    require_system(system)
    on, wave = choose_device(device), wavelength_of(system, wavelength)
    states = rest_states(system) if states is None else states
    if system.segmented is None:
        pupil = sunflower(system.pupil.obscuration, 1.0, rays)
        prepared = prepare_system(system, pupil.x, pupil.y, pupil.weight, terms, field, wave)
        return measure_system(prepared, states, on)
    light = _Light(_on_glass(system, rays), terms, field, wave)
    beyond = beyond_segments(system, states)
    if not beyond:
        return _by_segments(system, states, light, on)
    if states.segment_figure.any():
        raise UserError(
            f"{beyond}, which the trace of segments does not express, and their figures are known to no other"
        )
    return _in_sequence(system, states, light, on)


def _on_glass(system: OpticalSystem, rays: int) -> PupilRays:
    """Return so many rays or more, whole cubatures of each segment; spread evenly where it has no edges."""
    segments = system.segments
    if is_monolithic(segments):
        return on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, rays))
    found = (segment_rays(segments, points) for points in (1, 3, 6, 12))
    return next((one for one in found if len(one) >= rays), segment_rays(segments, 12))


def beyond_segments(system: OpticalSystem, states: States) -> str:
    """Return what of a segmented system the kernel for segments cannot express, in words; mostly nothing."""
    name, primary, image = system.name, system.primary, system.surfaces[-1]
    if (system.stop, system.segmented) != (0, M2 - 1) or not np.isinf(system.object_distance):
        return f"the segments of {name} are not those of a first mirror behind the stop, before a far object"
    moved = primary.position.any() or (primary.rotation != np.eye(3)).any()
    if moved or type(primary.shape) is not Conic or primary.opening or primary.deformation or primary.phase:
        return f"{primary.name} of {name} is more than a conic about the origin that carries segments"
    if states.surface_motion[:, :M2].any():
        return f"the stop or {primary.name} of {name} moves as a whole"
    for one in system.after_primary[:-1]:
        if _is_more(one):
            return f"{one.name} of {name} is more than a round mirror or lens, a conic or even asphere"
    if image.action != "pass" or image.shape != Conic() or image.phase or image.deformation:
        return f"the image of {name} is more than a plane"
    forms = [one.deformation for one in system.after_primary]
    terms = max((getattr(form, "terms", 0) for form in forms), default=0)
    alike = with_figures(system, system.segments.figure_terms, terms)
    if forms != [one.deformation for one in alike.after_primary]:
        return f"the mirrors of {name} after {primary.name} do not all deform alike, over their footprints"
    return ""


def _is_more(surface: Surface) -> bool:
    opening = surface.opening
    return (
        surface.action == "pass"
        or type(surface.shape) not in (Conic, EvenAsphere)
        or surface.phase is not None
        or isinstance(surface.medium, GradientIndex)
        or (opening is not None and opening != Opening(opening.outer))
    )


def _by_segments(system: OpticalSystem, states: States, light: _Light, device: Device) -> Wavefront:
    mirror = max((getattr(one.deformation, "terms", 0) for one in system.after_primary), default=0)
    figures = system.segments.figure_terms, mirror
    prepared = prepare(system, light.rays, light.wavelength, light.terms, *figures)
    count, rest = len(states), rest_states(prepared.system, padded(len(states)) - len(states))
    found = measure(at_field(prepared, system.fields[light.field]), joined([states, rest]), device)
    return replace(found, **{name: getattr(found, name)[:count] for name in ARRAYS})


def _in_sequence(system: OpticalSystem, states: States, light: _Light, device: Device) -> Wavefront:
    """Trace the light of each segment through the parent of M1 where the segment takes it."""
    rays, wave = light.rays, light.wavelength
    outer, parent = system.annulus.outer, parent_system(system)
    stop = replace(parent.surfaces[parent.stop], opening=None)  # the glass says where light passes
    parent = with_surface(parent, parent.stop, stop)
    whole = prepare_system(
        parent, rays.x / outer, rays.y / outer, rays.weight, light.terms, light.field, wave
    )
    chief, path = chief_points(whole, incoming_light(whole, states, device))
    shape = len(states), len(rays)
    found = {name: np.full(shape, np.nan) for name in ("path", "x", "y", "u", "v")}
    found |= {name: np.zeros(shape, dtype=np.int8) for name in ("w_sign", "status", "surface")}
    assert system.segmented is not None
    for number, motion in enumerate(_whole_motions(system, states)):
        mine = rays.segment == number
        own = states.surface_motion.copy()
        own[:, system.segmented] = motion
        glass = replace(parent.surfaces[system.segmented], opening=_glass(system, number))
        one = with_surface(parent, system.segmented, glass)
        here = replace(whole, system=one, sequence=pack(one, wave))
        moved = about_chief(here, incoming_light(here, replace(states, surface_motion=own), device), chief)
        part = Rays(whole.rays.position[:, mine], whole.rays.direction[:, mine], whole.rays.path[mine])
        traced = trace_sequence(here.sequence, part, moved, device)
        for name, values in found.items():
            values[:, mine] = getattr(traced, name)
    gap = (found["status"] == VIGNETTED) & (found["surface"] == system.segmented)
    found["status"][gap] = GAP
    opd, traced = path_differences(found["path"], path, wave), TracedRays(**found)  # type: ignore[arg-type]
    return analyse_system(whole, opd, traced, chief)


def _glass(system: OpticalSystem, number: int) -> Opening:
    """Return the opening of M1 that is the glass of a segment."""
    if is_monolithic(system.segments):
        return system.annulus
    return Opening(corners=tuple((float(x), float(y)) for x, y in system.segments.corners[number]))


def _whole_motions(system: OpticalSystem, states: States) -> Iterator[Array]:
    """Yield for each segment the motion (T, 6) of the parent of M1, about its vertex, that takes it along."""
    assert system.segmented is not None
    count = len(states)
    padding = [(0, padded(count) - count), (0, 0), (0, 0)]
    poses = from_tiles(segment_poses(system.segments, np.pad(states.segment_motion, padding)))[:count]
    body = states.surface_motion[:, system.segmented]
    turned = cardan(body[:, 3:])
    for undone in np.moveaxis(poses, 1, 0):  # q = A p + o
        turn = np.swapaxes(undone[:, :9].reshape(-1, 3, 3), 1, 2)
        shift = -(turn @ undone[:, 9:, None])
        yield np.hstack([body[:, :3] + (turned @ shift)[..., 0], cardan_angles(turned @ turn)])
