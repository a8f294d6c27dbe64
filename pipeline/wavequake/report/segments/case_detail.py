"""What no store keeps of a case: what was drawn for it, what moves, and the path of every ray."""

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.campaign.store.store import Manifest
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.registry import instants_of
from wavequake.mechanics.vibration.drive import values
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import respond
from wavequake.optics.shapes.motion_fit import figures, motion_fit
from wavequake.optics.systems.kinematics import at_instant
from wavequake.optics.wavefronts.wavefront import trace_system
from wavequake.report.segments.report import detail
from wavequake.workflows.exposures.telescope_control import CONTROLLERS, control_bench_of, measured_opd
from wavequake.workflows.exposures.telescope_exposure import case_blocks, scaled_draw
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens import experiment as lens
from wavequake.workflows.mirrors import trace as mirror
from wavequake.workflows.mirrors.base import driven
from wavequake.workflows.mirrors.bench import (
    bench_of,
    cases_of,
    drive_at,
    variant_of,
)
from wavequake.workflows.mirrors.optics import displacements_mm
from wavequake.workflows.mirrors.residual import coordinates_of, left_by, residual_of
from wavequake.workflows.segments.bench import bench_of as segment_bench
from wavequake.workflows.segments.bench import field_names
from wavequake.workflows.systems.bench import (
    MM_PER_M,
    NM_PER_MM,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.draws import draw
from wavequake.workflows.systems.measure import worst_instant

Array = NDArray[np.float64]

_DEGREES = ["dx", "dy", "dz", "rx", "ry", "rz"]
_RAYS_BYTES = (
    2**28
)  # of the paths of all rays at all instants; where they are more, the worst instant's alone


def detail_of(manifest: Manifest, case: int, device: str) -> xr.Dataset:
    """Return what a workflow can tell of a case beyond the numbers that it computes for the store.

    Instants are those that the case has (``instant``); nothing for workflows that draw and trace nothing.
    """
    found = _DETAILS.get(manifest.workflow)
    return found(manifest.study, case, device) if found else xr.Dataset()


def _variable(dims: tuple[str, ...], values: NDArray[np.generic], units: str, long_name: str) -> xr.Variable:
    return xr.Variable(dims, values, {"units": units, "long_name": long_name})


def _of_segments(study: str, case: int, device: str) -> xr.Dataset:
    """Return the motion of every segment and the path of every ray at every instant, at every place."""
    optics = segment_bench(study).study.optics
    points, colors = optics.points_arcmin, optics.colors_nm
    parts = [_at_field(study, case, device, place) for place in range(len(points) * len(colors))]
    rays = [part[["opd", "spot"]] for part in parts]
    rows = [rays[first : first + len(colors)] for first in range(0, len(rays), len(colors))]
    several = optics.wavelengths_nm is not None
    fields = [xr.concat(row, "wavelength") if several else row[0] for row in rows]
    both = xr.concat(fields, "field") if optics.fields_arcmin is not None else fields[0]
    found = parts[0].drop_vars(["opd", "spot"]).merge(both)
    coords: dict[str, list[Any]] = {"wavelength": list(colors)} if several else {}
    if optics.fields_arcmin is not None:
        coords |= {"field": field_names(points)}
    return found.assign_coords(coords)


def _at_field(study: str, case: int, device: str, place: int) -> xr.Dataset:
    found = detail(study, case, device, xr.Dataset(), place)
    over = ("instant", "ray")
    return xr.Dataset(
        {
            "segment_motion": _variable(
                ("instant", "segment", "dof"), found.segment_motion, "m, rad", "motion in the segment's frame"
            ),
            "opd": _variable(over, found.opd, "nm", "optical path difference; NaN: lost"),
            "spot": _variable((*over, "axis"), found.spot, "mas", "where rays meet the image"),
            "ray_x": _variable(("ray",), found.ray_x, "mm", "where rays meet the aperture"),
            "ray_y": _variable(("ray",), found.ray_y, "mm", "where rays meet the aperture"),
            "ray_segment": _variable(("ray",), found.ray_segment, "1", "segment that a ray hits, -1: none"),
        },
        {"segment": list(found.segment_names), "dof": _DEGREES},
    )


def _of_system(study: str, case: int, device_name: str) -> xr.Dataset:
    """Return what was drawn, how every surface moves by it, and the path of every ray."""
    bench, device = system_bench(study), choose_device(device_name)
    population, drawn = draw(bench, case)
    states, names = system_states(bench, drawn), [one.name for one in bench.system.surfaces]
    grid = (len(bench.prepared), len(bench.prepared[0]))
    rays, count = len(bench.prepared[0][0].pupil), len(drawn.mount)
    instants = np.arange(count)
    if count * grid[0] * grid[1] * rays * 3 * 8 > _RAYS_BYTES:
        time = instants_of(bench.study.disturbance, population)
        instants = np.array([worst_instant(bench, time, drawn, device)])
        traced_states = at_instant(states, int(instants[0]))
    else:
        traced_states = states
    opd = np.empty((len(instants), *grid, rays))
    spot = np.empty((*opd.shape, 2))
    for field, (row, still) in enumerate(zip(bench.prepared, bench.static, strict=True)):
        for wave, (prepared, rest) in enumerate(zip(row, still, strict=True)):
            path, traced, _ = trace_system(prepared, traced_states, device)
            opd[:, field, wave] = path * prepared.wavelength * NM_PER_MM
            spot[:, field, wave] = 1e3 * (np.stack([traced.x, traced.y], axis=-1) - rest.chief[0])
    motion = states.surface_motion.copy()
    motion[..., :3] /= MM_PER_M
    over, pupil = ("traced_instant", "field", "wavelength", "ray"), bench.prepared[0][0].pupil
    found = {
        "surface_motion": _variable(
            ("instant", "surface", "dof"), motion, "m, rad", "motion of every surface in its frame at rest"
        ),
        "sight": _variable(("instant", "axis"), drawn.mount, "rad", "rotation of the incoming light, drawn"),
        "opd": _variable(over, opd, "nm", "optical path difference; NaN: lost"),
        "spot": _variable(
            (*over, "axis"), spot, "um", "where rays meet the image, from the chief ray at rest"
        ),
        "ray_x": _variable(("ray",), pupil[:, 0], "1", "where rays pass the pupil, over its radius"),
        "ray_y": _variable(("ray",), pupil[:, 1], "1", "where rays pass the pupil, over its radius"),
    }
    if drawn.rigid:
        found["drawn_motion"] = _variable(
            ("instant", "element", "dof"),
            np.stack(list(drawn.rigid.values()), axis=1),
            "m, rad",
            "motion that was drawn for surfaces and bodies, each in its frame at rest",
        )
    if drawn.figure:
        given = list(drawn.figure.values())
        over_time = ("instant",) if any(one.ndim > 1 for one in given) else ()
        figure = np.zeros((*([count] * len(over_time)), len(given), max(one.shape[-1] for one in given)))
        for place, values in enumerate(given):
            figure[..., place, : values.shape[-1]] = values * 1e9
        found["drawn_figure"] = _variable(
            (*over_time, "deformed", "term"), figure, "nm", "Noll coefficients from 1 of surfaces' figures"
        )
    for place, (name, heights) in enumerate(drawn.grid.items()):
        dims = ("instant", f"row_{place}", f"column_{place}")
        found[f"given_grid_{place}"] = _variable(dims, 1e9 * heights, "nm", f"heights on the grid of {name}")
    labels = {"traced_instant": instants, "surface": names, "dof": _DEGREES}
    labels |= {"element": list(drawn.rigid)} if drawn.rigid else {}
    labels |= {"deformed": list(drawn.figure)} if drawn.figure else {}
    return xr.Dataset(found, labels)


def _of_exposure(study: str, case: int, device_name: str) -> xr.Dataset:
    """Return the motion of segments, mount and M2 that was drawn, and rays' paths by controller."""
    control, device = control_bench_of(study), choose_device(device_name)
    drawn = scaled_draw(control, case)
    rays, to_nm = control.prepared.rays, control.study.optics.wavelength_nm
    found = {
        "segment_motion": _variable(
            ("instant", "segment", "dof"),
            drawn.motion.segment_motion,
            "m, rad",
            "motion in the segment's frame, scaled",
        ),
        "mount": _variable(("instant", "axis"), drawn.motion.mount, "rad", "pointing of the mount, scaled"),
        "m2_sight": _variable(
            ("instant", "axis"), drawn.motion.m2, "rad", "line of sight that M2's disturbance makes, scaled"
        ),
        "ray_x": _variable(("ray",), rays.x, "mm", "where rays meet the aperture"),
        "ray_y": _variable(("ray",), rays.y, "mm", "where rays meet the aperture"),
        "ray_segment": _variable(("ray",), rays.segment, "1", "segment that a ray hits, -1: none"),
    }
    if len(CONTROLLERS) * len(drawn.time) * len(rays.x) * 8 <= _RAYS_BYTES:
        paths = [
            np.concatenate(
                [
                    measured_opd(control, traced)[:count] * to_nm
                    for count, traced, _ in case_blocks(control, drawn, device, controller)
                ]
            )
            for controller in CONTROLLERS
        ]
        words = "optical path difference about the chief ray"
        found["opd"] = _variable(("controller", "instant", "ray"), np.stack(paths), "nm", words)
    segments = list(control.bench.system.segments.names)
    return xr.Dataset(found, {"segment": segments, "dof": _DEGREES})


def _of_plant(study: str, case: int, device: str) -> xr.Dataset:
    """Return the plant that was drawn, and the noise of its readings."""
    record = study_of(study)
    plant = lens.plant_of(record, *lens.case_of(record, case))
    bench, stage = plant.bench, plant.stage

    def roots(which: tuple[complex, ...]) -> Array:
        return np.array([[one.real, one.imag] for one in map(complex, which)])

    return xr.Dataset(
        {
            "lens_springs": _variable(("lens",), bench.lens_springs, "N/m", "springs of lenses in rings"),
            "ring_springs": _variable(
                ("lens",), bench.ring_springs, "N/m", "springs of rings in the housing"
            ),
            "couplings": _variable(("gap",), bench.couplings, "N/m", "springs between neighboring rings"),
            "housing_spring": _variable((), np.array(bench.housing_spring), "N/m", "spring of the housing"),
            "stage_gain": _variable((), np.array(stage.gain), "1", "gain of the stage"),
            "stage_poles": _variable(("pole", "part"), roots(stage.poles), "1/s", "poles of the stage"),
            "blow_strength": _variable(
                ("blow",), np.array(plant.blows), "1", "strength of the hammer over the nominal one"
            ),
            "trigger_late": _variable((), np.array(plant.late), "s", "how late the trigger is seen"),
            "strip_phase": _variable(("wave",), plant.phases, "rad", "phases of the strip's error"),
            "converter_noise": _variable(
                ("blow", "plant_instant"), plant.noise, "1", "noise of the converter's readings, of rms 1"
            ),
            "camera_noise": _variable(
                ("frame",), plant.frame_noise, "1", "noise of the camera's readings, of rms 1"
            ),
        },
        {
            "blow": ["identification", "controlled"],
            "part": ["real", "imaginary"],
            "lens": np.arange(1, len(bench.lens_springs) + 1),
        },
    )


def _of_mirror(text: str, case: int, device_name: str) -> xr.Dataset:
    """Return inputs, coordinates, figures and Zernike coefficients over time, by both methods."""
    study, device = study_of(text), choose_device(device_name)
    name, variant = cases_of(study)[case]
    bench, time = bench_of(text, name), study.time.seconds
    reduced, optics, clock = variant_of(bench, variant), bench.optics, Stopwatch()
    motion = motion_fit(optics.surface, displacements_mm(reduced.surface.T))
    left, parts = left_by(optics, reduced), []
    for excitation in study.excitation:
        drive = drive_at(excitation, reduced, study)
        held, seen = driven(reduced, drive, excitation.name)
        response = respond(modal_model(held, seen.prescribed), [seen], time)
        coordinates = coordinates_of(response)
        needed = left.share(coordinates) > study.optics.residual_limit
        rest = residual_of(optics, left, device) if needed else None
        traced = mirror.standard_method(optics, motion, coordinates, device, clock, rest)
        summed = mirror.modal_method(optics, reduced.surface, response, clock, rest)
        parts.append(
            (
                values(drive, time),
                coordinates,
                figures(motion, coordinates) * NM_PER_MM,
                traced.aberrations[:, 2:],
                summed.aberrations[:, 2:],
            )
        )
    inputs, coordinates, fitted, standard, modal = (np.stack(part) for part in zip(*parts, strict=True))
    over = ("excitation", "time")
    words = "what drives the interfaces, x, y, z of each: displacements or forces; impulses are not in it"
    return xr.Dataset(
        {
            "input": _variable((*over, "input_direction"), inputs, "m or N", words),
            "coordinate": _variable((*over, "coordinate_number"), coordinates, "1", "of the reduced model"),
            "figure": _variable((*over, "noll"), fitted, "nm", "Zernike coefficients of the surface"),
            "zernike_standard": _variable(
                (*over, "noll"), standard, "nm", "Zernike coefficients of the wavefront, every ray traced"
            ),
            "zernike_modal": _variable((*over, "noll"), modal, "nm", "the same by sensitivities of modes"),
        },
        {"noll": np.arange(1, fitted.shape[2] + 1)},
    )


_DETAILS: dict[str, Callable[[str, int, str], xr.Dataset]] = {
    "segment-disturbance": _of_segments,
    "system-disturbance": _of_system,
    "telescope-exposure": _of_exposure,
    "lens-experiment": _of_plant,
    "mirror-trace": _of_mirror,
}
