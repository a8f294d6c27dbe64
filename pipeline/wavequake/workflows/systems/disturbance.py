"""The workflow ``system-disturbance``: Monte Carlo of any optical system whose surfaces move and deform.

One case is one realization of one population of disturbances over its instants; every instant is traced for
all fields and wavelengths.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.measures import Measure
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import noise_of, seen
from wavequake.chain.images.system import SystemImager
from wavequake.chain.nodal import nodal_sources
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.trace.sequence import bends
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.mechanics.disturbances.registry import draw_case, instants_of
from wavequake.optics.rays.packing import moving
from wavequake.optics.systems.file import build
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import rest_states
from wavequake.words import counted
from wavequake.workflows.bodies.plants import standing
from wavequake.workflows.disturbed_study import case_labels
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.modal import MODAL, TRACED
from wavequake.workflows.systems.bench import (
    NM_PER_MM,
    SystemBench,
    beyond_rounding,
    field_name,
    imager_on,
    lost_light,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.draws import draw, drawn_with, sampling_plan
from wavequake.workflows.systems.measure import See, measured_cases
from wavequake.workflows.systems.measures import axes, fixed, measures
from wavequake.workflows.systems.modal import certificate, model_of, routes
from wavequake.workflows.systems.streaks import places_between, places_of_rows, streaked_times
from wavequake.workflows.systems.study import SystemStudy
from wavequake.workflows.systems.variants import errors_of, slot_of

Array = NDArray[np.float64]

# Of the states of cases that are computed together; they are copied a few times.
_NUMBERS = 1 << 20


def sight_between(
    bench: SystemBench, population: ElementDisturbance, realization: int, model: str
) -> Array | None:
    """Return where the line of sight is between the exposed instants of a realization, if it is followed."""
    at = streaked_times(bench.study, population)
    if at is None:
        return places_of_rows(bench, population, drawn_with(bench, population, realization, model))
    return places_between(bench, at.shape, drawn_with(bench, population, realization, model, at.ravel()))


def prepare(study: SystemStudy) -> SystemBench:
    """Return what all cases of a study share; raises as `system_bench`, and where disturbances do not fit."""
    bench = system_bench(study.identity_text())
    sampling_plan(bench.text)
    if study.optics.light == "modal":
        model_of(bench.text, choose_device(study.campaign.device).name)
    for population in study.disturbance:
        drawn = draw_case(study.disturbance, population, bench.layout, study.study.seed, 0)
        moving(bench.system, system_states(bench, drawn))
    return bench


def compute(bench: SystemBench, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Compute cases; one in which a field's light is lost is quarantined with the reason.

    Matrix products are made case by case, so that the bits of a case depend on no other.
    """
    imager = imager_on(bench.text, device_name)
    cases, populations = table["case"].tolist(), bench.study.disturbance
    most = max(1, _NUMBERS // _numbers_of_a_case(bench))
    for first in range(0, len(cases), most):
        with clock("draw"):
            drawn = [draw(bench, case) for case in cases[first : first + most]]
            away = [sight_between(bench, *slot_of(bench.study, case)) for case in cases[first : first + most]]
        motions = [(instants_of(populations, population), motion) for population, motion in drawn]
        found = _seen_cases(bench, cases[first : first + most], motions, away, device_name, clock)
        if bench.study.reduction is not None:
            found = [
                (numbers if message else numbers | errors_of(numbers, full), message)
                for (numbers, message), full in zip(
                    found,
                    _with_full_models(bench, cases[first : first + most], device_name, clock),
                    strict=True,
                )
            ]
        for row, (numbers, message) in enumerate(found, first):
            if imager is not None and not message:
                numbers |= _seen(bench, imager, cases[row], numbers["exposure"])
            result = {name: np.asarray(values)[None] for name, values in numbers.items()}
            yield Block(result, np.array([row]), {0: message} if message else {})


def _seen(bench: SystemBench, imager: SystemImager, case: int, exposures: Array) -> dict[str, Array]:
    """Return what the camera makes of the exposures of a case; all models of a draw have the same noise."""
    population, realization, _ = slot_of(bench.study, case)
    noise = noise_of(bench.study.study.seed, population.name, realization)
    return seen(imager.camera, exposures, noise)


def _seen_cases(
    bench: SystemBench,
    cases: list[int] | None,
    motions: list[tuple[Array, Motion]],
    away: list[Array | None],
    device_name: str,
    clock: Stopwatch,
) -> list[tuple[dict[str, Array], str]]:
    """Return the numbers of cases and why one has none: traced, or by the modal model as far as it reaches.

    The model's errors are measured and returned of `cases` alone.
    """
    study, device, imager = bench.study, choose_device(device_name), imager_on(bench.text, device_name)
    if study.optics.light == "traced":
        return measured_cases(bench, motions, device, clock, imager, away)
    model = model_of(bench.text, device_name)
    bounds = np.array([model.bound(drawn) for _, drawn in motions])
    how = routes(study, cases, bounds)

    def chosen(rows: NDArray[np.intp], see: See | None) -> dict[int, tuple[dict[str, Array], str]]:
        found = measured_cases(
            bench, [motions[row] for row in rows], device, clock, imager, [away[row] for row in rows], see
        )
        return dict(zip(rows.tolist(), found, strict=True))

    modal, full = chosen(np.flatnonzero(how != TRACED), model.see), chosen(np.flatnonzero(how != MODAL), None)
    found = []
    for row, (bound, route) in enumerate(zip(bounds, how, strict=True)):
        numbers, message = modal[row] if row in modal else full[row]
        traced, lost = full.get(row, ({}, ""))
        silent = cases is None or message or lost
        more = {} if silent else certificate(study, bound, route, numbers, traced)
        found.append((numbers | more, message or lost))
    return found


def _with_full_models(
    bench: SystemBench, cases: list[int], device_name: str, clock: Stopwatch
) -> list[dict[str, Array]]:
    """Return the numbers of the same draws with the full models; each draw once."""
    slots = [slot_of(bench.study, case) for case in cases]
    draws = {(population.name, realization): population for population, realization, _ in slots}
    motions = [
        (instants_of(bench.study.disturbance, population), drawn_with(bench, population, realization, FULL))
        for (_, realization), population in draws.items()
    ]
    away = [sight_between(bench, population, number, FULL) for (_, number), population in draws.items()]
    found = dict(zip(draws, _seen_cases(bench, None, motions, away, device_name, clock), strict=True))
    return [found[population.name, realization][0] for population, realization, _ in slots]


def _numbers_of_a_case(bench: SystemBench) -> int:
    """Return how many numbers describe the motion of a case, at most."""
    still = rest_states(bench.system)
    instant = still.surface_motion.size + sum(form.size for form in still.deformations if form is not None)
    return instant * max(population.instants for population in bench.study.disturbance)


def measures_of(bench: SystemBench) -> Iterator[Measure]:
    """Yield the measures of a study."""
    return measures(bench.study, over_annulus(bench))


def fixed_of(bench: SystemBench) -> dict[str, Fixed]:
    """Return what a store of a study holds beside its measures."""
    return fixed(bench, over_annulus(bench))


def over_annulus(bench: SystemBench) -> dict[str, str]:
    """Return over which annulus the polynomials of the stored coefficients are orthogonal, as a label."""
    inner = bench.system.pupil.obscuration if bench.study.wavefront.basis == "annular" else 0.0
    return {"obscuration": repr(float(inner))}


def describe(bench: SystemBench) -> dict[str, str]:
    """Return first-order data of the system and its wavefronts at rest, for the plan."""
    system, rays = bench.system, bench.study.optics.rays
    errors = [
        [
            beyond_rounding(one.rms[0], 1.0) * prepared.wavelength * NM_PER_MM
            for prepared, one in zip(*pair, strict=True)
        ]
        for pair in zip(bench.prepared, bench.static, strict=True)
    ]
    lines = {
        f"field {field_name(system, field)}": f"{row[system.primary_wavelength]:.4g} nm rms at rest"
        + (f", {max(row):.4g} at another wavelength" if max(row) > row[system.primary_wavelength] else "")
        + _missing(bench, field)
        for field, row in enumerate(errors)
    }
    return {
        "rays": f"{rays} per field and wavelength"
        + (", which bend where the index varies" if bends(bench.prepared[0][0].sequence) else ""),
        **sampling_plan(bench.text).words(),
        **_modal(bench),
        **lines,
        **standing(bench.plants),
        **{f"nodes of {name}": one.words for name, one in bench.layout.moved.items()},
        "system": info(system),
    }


def _modal(bench: SystemBench) -> dict[str, str]:
    """Say what the modal model knows, if the study takes it."""
    if bench.study.optics.light == "traced":
        return {}
    device = choose_device(bench.study.campaign.device)  # by its name, as `compute` asks for it
    count = int(model_of(bench.text, device.name).columns.moving.sum())
    return {
        "light": f"by the modal model of {counted(count, 'motion')}; a sample of the cases is traced, too"
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


def notices(study: SystemStudy) -> Iterator[str]:
    """Yield what a lens file says that is not understood, and what is computed more than once in vain."""
    if study.system.file_text is not None and (note := build(study.system).note):
        yield note
    if any(nodal_sources(study.disturbance)):
        moved = system_bench(study.identity_text()).layout.moved
        yield from (f"{name}: {one.words}." for name, one in moved.items())
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


def work(bench: SystemBench, cases: int) -> dict[str, tuple[float, str]]:
    """Return the number of ray-surfaces traced for `cases` cases."""
    populations, rays = bench.study.disturbance, bench.study.optics.rays
    instants = sum(one.share * one.instants for one in populations) / sum(one.share for one in populations)
    beams = len(bench.prepared) * len(bench.prepared[0])
    if bench.study.optics.light == "modal":
        return {"modal": (cases * instants * beams, "wavefronts")}
    return {"trace": (cases * instants * beams * rays * len(bench.system.surfaces), "ray-surfaces")}


KIND = study_kind(
    "system-disturbance",
    SystemStudy,
    prepare=prepare,
    cases=case_labels,
    compute=compute,
    measures=measures_of,
    axes=axes,
    fixed=fixed_of,
    describe=describe,
    work=work,
    notices=notices,
    compared=("disturbance", "reduction"),
)
