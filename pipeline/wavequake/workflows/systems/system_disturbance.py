"""The workflow ``system-disturbance``: Monte Carlo of any optical system whose surfaces move and deform.

One case is one realization of one population of disturbances over its instants; every instant is traced for
all fields and wavelengths.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, StudyKind, Template, Variable
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.trace.sequence import bends
from wavequake.mechanics.disturbances.element_motion import (
    ElementDisturbance,
    ElementMotion,
    draw_elements,
    instants_of,
)
from wavequake.mechanics.disturbances.registry import Combine
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.optics.rays.packing import moving
from wavequake.optics.systems.file import build
from wavequake.optics.systems.kinematics import rest_states
from wavequake.prepared import prepared
from wavequake.workflows.sampling import Plan, plan_of, replicate_labels
from wavequake.workflows.segments.segment_disturbance import slot
from wavequake.workflows.segments.segment_template import wavefront_source
from wavequake.workflows.systems.system_bench import (
    NM_PER_MM,
    SystemBench,
    field_name,
    lost_light,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.system_measure import measured_cases, shaped, wavefront_numbers
from wavequake.workflows.systems.system_study import SystemStudy

Array = NDArray[np.float64]

# Of the states of cases that are computed together; they are copied a few times.
_NUMBERS = 1 << 20


def draw(bench: SystemBench, case: int) -> tuple[ElementDisturbance, ElementMotion]:
    """Return the population of a case and its motion: of seed, disturbance and realization only."""
    study = bench.study
    population, realization = slot(study.disturbance, case)
    streams = sampling_plan(bench.text).of(realization)
    return population, draw_elements(study.disturbance, population, study.study.seed, realization, streams)


@prepared(maxsize=2)
def sampling_plan(study_text: str) -> Plan:
    """Return what spreads the random numbers of the study with this identity text.

    Raises
    ------
    UserError
        If they are too many for the plan that the study asks for.
    """
    study = study_from_identity(SystemStudy, study_text)
    singles = [entry for entry in study.disturbance if not isinstance(entry, Combine)]

    def draw_all(streams: Streams) -> None:
        for entry in singles:
            draw_elements(singles, entry, study.study.seed, 0, streams)

    shares = [entry.share for entry in study.disturbance]
    return plan_of(study.campaign, study.study.seed, shares, draw_all, lambda name: True)


def compute(study_text: str, cases: NDArray[np.int64], device_name: str) -> ChunkResult:
    """Compute the numbers of `cases`; one in which a field's light is lost is quarantined with the reason.

    With one BLAS thread, and matrix products case by case, so that the bits of a case depend on no other.
    """
    bench, device = system_bench(study_text), choose_device(device_name)
    arrays = {
        name: np.full((len(cases), *variable.shape), np.nan, dtype=variable.dtype)
        for name, variable in template(study_text).per_case.items()
    }
    messages, clock = [""] * len(cases), Stopwatch()
    most = max(1, _NUMBERS // _numbers_of_a_case(bench))
    with threadpool_limits(1):
        for first in range(0, len(cases), most):
            with clock("draw"):
                drawn = [draw(bench, case) for case in cases[first : first + most].tolist()]
            populations = bench.study.disturbance
            motions = [(instants_of(populations, population), motion) for population, motion in drawn]
            found = measured_cases(bench, motions, device, clock)
            for row, (numbers, message) in enumerate(found, first):
                messages[row] = message
                for name, values in numbers.items():
                    arrays[name][row][tuple(slice(0, size) for size in values.shape)] = values
    status = np.array([RAISED if message else DONE for message in messages], dtype=np.int8)
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def _numbers_of_a_case(bench: SystemBench) -> int:
    """Return how many numbers describe the motion of a case, at most."""
    still = rest_states(bench.system)
    instant = still.surface_motion.size + sum(form.size for form in still.deformations if form is not None)
    return instant * max(population.instants for population in bench.study.disturbance)


def case_table(study_text: str, first: int, last: int) -> dict[str, NDArray[np.generic]]:
    """Return the labels of cases first <= id < last: disturbance, realization and seed."""
    study = study_from_identity(SystemStudy, study_text)
    slots = [slot(study.disturbance, case) for case in range(first, last)]
    realizations = np.array([realization for _, realization in slots], dtype=np.int64)
    return {
        "disturbance": np.array([population.name for population, _ in slots], dtype=object),
        "realization": realizations,
        "seed": np.full(last - first, study.study.seed, dtype=np.int64),
        **replicate_labels(study.campaign, realizations),
    }


def template(study_text: str) -> Template:
    """Return what a store of this study holds."""
    bench = system_bench(study_text)
    study = bench.study
    instants = max(population.instants for population in study.disturbance)
    grid = {"field": len(bench.prepared), "wavelength": len(bench.prepared[0])}
    kind = {
        "annular": "Noll Zernike coefficients",
        "circular": "equivalent circular Noll Zernike coefficients (Störkle 2018, Eq. 3.53)",
    }[study.wavefront.basis]
    source = wavefront_source(study.wavefront.method, study.wavefront.reference)
    sizes = {"time": instants, **grid, "noll": study.wavefront.zernike_terms, "axis": 2}

    def variable(units: str, long_name: str, *dims: str, **more: str) -> Variable:
        attrs = {"units": units, "long_name": long_name, **more}
        return Variable(dims, tuple(sizes[dim] for dim in dims), attrs)

    over = ("time", "field", "wavelength")
    per_case = {
        "time_s": Variable(
            ("time",),
            (instants,),
            {"units": "s", "long_name": "time of the instant; NaN beyond the population's instants"},
            coordinate=True,
        ),
        "wfe_rms": variable("nm", "wavefront error rms of the fitted Zernikes j >= 4", *over),
        "wfe_change": variable(
            "nm", "rms of the wavefront's change from rest, of the fitted Zernikes j >= 4", *over
        ),
        "wfe_rms_raw": variable(
            "nm",
            "wavefront error rms over the rays that arrive, piston removed, tilt about the image point of "
            + {"chief": "the chief ray", "fitted": "the best-fit sphere"}[study.wavefront.reference],
            *over,
        ),
        "wfe_pv": variable("nm", "peak to valley of the wavefront about its best-fit plane", *over),
        "zernike": replace(
            variable("nm", f"{kind}, total{source}", *over, "noll", **over_annulus(bench)),
            unknown=int(study.wavefront.method == "slopes"),
        ),
        "los_mm": variable(
            "mm",
            "line of sight of the best-fit plane in the image, relative to rest "
            "(Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))",
            *over,
            "axis",
        ),
        "centroid_mm": variable(
            "mm", "geometric centroid of the rays in the image, relative to rest", *over, "axis"
        ),
        "spot_rms": variable("um", "rms distance of the rays' image points from their centroid", *over),
        "strehl": variable("1", "Strehl ratio in the direction of the best-fit plane", *over),
        "rayleigh": variable(
            "1",
            "share of instants with a peak to valley of at most lambda/4 (Störkle 2018, Eq. 3.54)",
            *over[1:],
        ),
        "marechal": variable(
            "1",
            "share of instants with an rms over the rays, piston and tilt removed, of at most lambda/14 "
            "(Störkle 2018, Eq. 3.55)",
            *over[1:],
        ),
        "vignetted": variable("1", "largest number of rays at an instant that openings stop", *over[1:]),
        "lost": variable("1", "largest number of rays at an instant that do not arrive", *over[1:]),
    }
    return Template(per_case, _fixed(bench))


def over_annulus(bench: SystemBench) -> dict[str, str]:
    """Return over which annulus the polynomials of the stored coefficients are orthogonal, as a label."""
    inner = bench.system.pupil.obscuration if bench.study.wavefront.basis == "annular" else 0.0
    return {"obscuration": repr(float(inner))}


def _fixed(bench: SystemBench) -> dict[str, tuple[tuple[str, ...], NDArray[np.generic], dict[str, str]]]:
    system = bench.system
    far = bool(np.isinf(system.object_distance))
    points = np.rad2deg(system.fields) if far else system.fields
    grid = ("field", "wavelength")

    def still(
        name: str, units: str, long_name: str, *more: str, **attrs: str
    ) -> tuple[tuple[str, ...], Array, dict[str, str]]:
        rows = [
            wavefront_numbers(prepared, rest, rest, bench.study.wavefront.basis)[name]
            for row, found in zip(bench.prepared, bench.static, strict=True)
            for prepared, rest in zip(row, found, strict=True)
        ]
        values = shaped(bench, rows)
        return (
            (*grid, *more),
            values[0] if values.ndim > 2 else values,
            {"units": units, "long_name": long_name, **attrs},
        )

    names = np.array([field_name(system, field) for field in range(len(points))], dtype=object)
    unit = {"units": "deg" if far else "mm"}
    return {
        "field": (("field",), names, {"long_name": "field point"}),
        "field_x": (("field",), points[:, 0], {**unit, "long_name": "field point along x"}),
        "field_y": (("field",), points[:, 1], {**unit, "long_name": "field point along y"}),
        "wavelength": (
            ("wavelength",),
            np.round(system.wavelengths * NM_PER_MM, 9),  # as it was written in nm
            {"units": "nm", "long_name": "wavelength"},
        ),
        "noll": (
            ("noll",),
            np.arange(1, bench.study.wavefront.zernike_terms + 1),
            {"long_name": "Noll index"},
        ),
        "axis": (("axis",), np.array(["x", "y"], dtype=object), {"long_name": "axis of the image plane"}),
        "zernike_static": still(
            "zernike", "nm", "Zernike coefficients at rest", "noll", **over_annulus(bench)
        ),
        "wfe_rms_static": still("wfe_rms", "nm", "wavefront error rms at rest, j >= 4"),
        "spot_rms_static": still("spot_rms", "um", "rms spot radius at rest"),
        "strehl_static": still("strehl", "1", "Strehl ratio at rest"),
        "vignetted_static": still("vignetted", "1", "rays that openings stop at rest"),
    }


def describe(study_text: str) -> dict[str, str]:
    """Return first-order data of the system and its wavefronts at rest, for the plan."""
    bench = system_bench(study_text)
    system, rays = bench.system, bench.study.optics.rays
    errors = [
        max(one.rms[0] * prepared.wavelength * NM_PER_MM for prepared, one in zip(*pair, strict=True))
        for pair in zip(bench.prepared, bench.static, strict=True)
    ]
    lines = {
        f"field {field_name(system, field)}": f"{error:.4g} nm rms at rest" + _missing(bench, field)
        for field, error in enumerate(errors)
    }
    return {
        "rays": f"{rays} per field and wavelength"
        + (", which bend where the index varies" if bends(bench.prepared[0][0].sequence) else ""),
        **sampling_plan(study_text).words(),
        **lines,
        "system": system.info(),
    }


def _missing(bench: SystemBench, field: int) -> str:
    """Say how many rays of a field point do not arrive at rest, at the wavelength with the fewest that do."""
    rays, counts = bench.study.optics.rays, [int(one.lost[0]) for one in bench.static[field]]
    worst = counts.index(max(counts))
    lost, stopped = counts[worst], int(bench.static[field][worst].vignetted[0])
    if not lost:
        return ""
    why = f"{stopped} of {rays} rays vignetted"
    if lost > stopped:
        why = lost_light(bench.prepared[field][worst], rest_states(bench.system), 0)
    return f" of a fit over the full pupil, of which {1.0 - lost / rays:.0%} arrives: {why}"


def notices(study_text: str) -> Iterator[str]:
    """Yield what a lens file says that is not understood, and what is computed more than once in vain."""
    study = study_from_identity(SystemStudy, study_text)
    if study.system.file_text is not None and (note := build(study.system).note):
        yield note
    repeated, shares = study.repeated, [entry for entry in study.disturbance if entry.share]
    if len(repeated) == len(shares):
        count = sum(one.share for one in shares)
        yield f"Nothing in this study is random: it has {count} case{'s' if count > 1 else ''}."
        return
    for name in repeated:
        yield (
            f"Nothing in {name} is random, so all its cases are alike; with share = 0 it is a part of "
            "combinations only."
        )


def check(study_text: str) -> None:
    """Raise UserError if the system at rest has no image, or a disturbance does not fit the system."""
    bench = system_bench(study_text)
    sampling_plan(study_text)
    for population in bench.study.disturbance:
        drawn = draw_elements(bench.study.disturbance, population, bench.study.study.seed, 0)
        moving(bench.system, system_states(bench, drawn))


def work(study_text: str, cases: int) -> dict[str, tuple[float, str]]:
    """Return the number of ray-surfaces traced for `cases` cases."""
    bench = system_bench(study_text)
    populations, rays = bench.study.disturbance, bench.study.optics.rays
    instants = sum(one.share * one.instants for one in populations) / sum(one.share for one in populations)
    beams = len(bench.prepared) * len(bench.prepared[0])
    return {"trace": (cases * instants * beams * rays * len(bench.system.surfaces), "ray-surfaces")}


KIND = StudyKind(
    "system-disturbance", template, case_table, compute, describe, work, check, notices, model=SystemStudy
)
