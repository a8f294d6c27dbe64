"""The workflow ``segment-disturbance``: Monte Carlo of disturbed segments and line of sight.

One case is one realization of one population of disturbances over its instants: motions of segments and M2
are drawn (`mechanics`), every instant is ray traced and its wavefront measured (`kernels`, `optics`), and the
instants' point spread functions make the case's exposure (`imaging`).
"""

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, unknown_arrays
from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import require_pixels
from wavequake.chain.images.extended import check_object
from wavequake.chain.sampling import slots
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import padded
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.registry import (
    Disturbance,
    analytic_rms,
    draw_case,
    instants_of,
    parts,
)
from wavequake.mechanics.disturbances.sources import edge_sensors
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.wavefronts.quality import meets_marechal, meets_rayleigh
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.workflows.bodies.plants import standing
from wavequake.workflows.disturbed_study import case_labels
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.bench import (
    MAS_PER_RAD,
    Bench,
    bench_of,
    benches_of,
    in_basis,
    monolithic,
)
from wavequake.workflows.segments.draws import draw_realizations, sampling_plan, way_between
from wavequake.workflows.segments.exposures import (
    Gathered,
    add_energies,
    add_images,
    coarse_figures,
    exposed,
    frame_notices,
    gather,
    images_of_stills,
    ray_notices,
)
from wavequake.workflows.segments.images import (
    camera_of,
    refuse_what_cannot_be_imaged,
)
from wavequake.workflows.segments.judged_models import judged
from wavequake.workflows.segments.launches import (
    CaseDraw,
    Piece,
    launches,
    lost_segment,
    put_states,
    states_at_rest,
    traced_instants,
)
from wavequake.workflows.segments.modal import modal_cases
from wavequake.workflows.segments.model import model_of
from wavequake.workflows.segments.rare import rare_cases
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.segments.template import (
    OF_ALL_PLACES,
    axes,
    fixed,
    measures,
    memory,
    of_one_place,
    over_places,
    place_axis,
    places_of,
)
from wavequake.workflows.segments.vignetting import require_all_rays
from wavequake.workflows.systems.out_of_focus import require_focus

Array = NDArray[np.float64]

_TOGETHER = 16  # exposures whose energies are looked at: they stay in the cache


def draw(bench: Bench, case: int) -> CaseDraw:
    """Draw the motion of one case: of seed, disturbance, realization and model of the segments only."""
    return _draw_all(bench, np.array([case]))[0]


def _draw_all(bench: Bench, cases: NDArray[np.int64]) -> list[CaseDraw]:
    """Draw the motions of cases, those of a population and a model together."""
    study = bench.study
    which, places = slots([population.share for population in study.disturbance], cases)
    realizations, models = np.divmod(places, len(study.compared))
    draws: dict[int, CaseDraw] = {}
    for index, place in product(range(len(study.disturbance)), range(len(study.compared))):
        rows = np.flatnonzero((which == index) & (models == place)).tolist()
        population, model = study.disturbance[index], study.compared[place]
        drawn = _drawn_with(bench, population, realizations[rows].tolist(), model)
        draws |= zip(rows, drawn, strict=True)
    return [draws[row] for row in range(len(cases))]


def _drawn_with(
    bench: Bench, population: Disturbance, realizations: Sequence[int], model: str
) -> Iterator[CaseDraw]:
    """Draw realizations of a population with one of the models that the study compares."""
    time = instants_of(bench.study.disturbance, population)
    motions = draw_realizations(bench, population, realizations, model)
    for realization, motion in zip(realizations, motions, strict=True):
        way = None
        if bench.study.imaging.enabled:
            way = way_between(bench, population, realization, time, motion, model)
        yield CaseDraw(population, realization, time, motion, way, model)


def prepare(study: SegmentStudy) -> Bench:
    """Return what all cases of a study share; raises as `bench_of`."""
    return bench_of(study.identity_text())


def compute(bench: Bench, table: CaseTable, device_name: str, clock: Stopwatch) -> Block:
    """Compute the numbers of cases over their instants, by full traces or by the modal model."""
    text, cases = bench.text, table["case"]
    if bench.study.optics.light == "modal":
        found = modal_cases(text, cases, device_name, trace_cases)
    else:
        found = trace_cases(text, cases, device_name)
    clock.seconds |= found.timings
    weights = {}
    if bench.study.rare is not None:
        weights = rare_cases(text).labels(cases)  # one disturbance: the case is its realization
    messages = {row: message for row, message in enumerate(found.messages) if message}
    return Block({**found.arrays, **weights}, messages=messages)


def trace_cases(study_text: str, cases: NDArray[np.int64], device_name: str) -> ChunkResult:
    """Compute the numbers of `cases` over their instants by full traces.

    A case in which a segment loses all its rays, or is tilted beyond what can be imaged, is quarantined with
    the reason.
    """
    bench = bench_of(study_text)
    start = Stopwatch()
    with start("draw"):
        draws = _draw_all(bench, cases)
    if bench.study.reduction is None:
        return trace_draws(study_text, draws, device_name, start)
    with start("draw"):
        whole = {(one.population.name, one.realization) for one in draws if one.model == FULL}
        for one in tuple(draws):
            key = one.population.name, one.realization
            if key not in whole:
                draws += _drawn_with(bench, one.population, [one.realization], FULL)
                whole.add(key)
    return judged(bench, draws, trace_draws(study_text, draws, device_name, start), len(cases))


def trace_draws(
    study_text: str, draws: list[CaseDraw], device_name: str, clock: Stopwatch | None = None
) -> ChunkResult:
    """Trace motions that were drawn, at every field point and wavelength; as :func:`trace_cases`."""
    clock, benches = clock or Stopwatch(), benches_of(study_text)
    found = [_trace_place(bench, draws, device_name, clock) for bench in benches]
    if len(places := places_of(benches[0].study)) == 0:
        return found[0]
    status = np.max([one.status for one in found], axis=0)
    arrays = {
        name: found[0].arrays[name]
        if name in OF_ALL_PLACES
        else over_places(places, [one.arrays[name] for one in found], 1 + place_axis(variable))
        for name, variable in of_one_place(study_text).items()
    }
    for array in arrays.values():
        array[status != DONE] = np.nan
    messages = [""] * len(draws)
    for bench, one in zip(benches, found, strict=True):
        told = [f"at {bench.where}: {text}" if text else "" for text in one.messages]
        messages = [first or text for first, text in zip(messages, told, strict=True)]
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def _trace_place(bench: Bench, draws: list[CaseDraw], device_name: str, clock: Stopwatch) -> ChunkResult:
    """Trace motions that were drawn at the place of a bench; as :func:`trace_cases`."""
    device = choose_device(device_name)
    arrays = unknown_arrays(of_one_place(bench.text), len(draws))
    for name in ("rayleigh", "marechal", "vignetted"):  # gathered over a case's launches
        arrays[name][:] = 0.0
    messages, instants = [""] * len(draws), [traced_instants(drawn) for drawn in draws]
    gathered: dict[int, Gathered] = {}
    for launch in launches(draws, instants):
        with clock("draw"):
            states = states_at_rest(bench, padded(max(piece.here.stop for piece in launch)))
            for piece in launch:
                put_states(states, piece.place, bench, draws[piece.row], slice(piece.first, piece.last))
        with clock("trace"):
            chief = chief_rays(bench.prepared, states)
            rays = trace_states(bench.prepared, states, device, chief)
        with clock("wavefront"):
            wavefront = analyse(bench.prepared, rays, chief, device)
        stills: dict[int, Array] = {}
        if "exposure" in arrays:
            with clock("image"):
                stills = images_of_stills(bench, wavefront, launch, draws, instants)
        for piece in launch:
            row, drawn = piece.row, draws[piece.row]
            messages[row] = messages[row] or lost_segment(bench.system, drawn, wavefront, piece)
            if messages[row]:
                continue
            whole = instants[row] == 1  # the piece stands for all instants
            there = slice(0, len(drawn.time)) if whole else slice(piece.first, piece.last)
            _record(bench, arrays, piece, there, wavefront, drawn)
            if "exposure" not in arrays:
                continue
            try:
                with clock("image"):
                    if row not in gathered:
                        gathered[row] = gather(bench, drawn.way)
                    add_images(bench, gathered[row], rays, wavefront, piece, stills.get(row))
            except UserError as error:  # tilts that no image can be made of concern this case alone
                messages[row] = str(error)
    status, exposures = np.full(len(draws), DONE, dtype=np.int8), dict[int, Array]()
    for row, message in enumerate(messages):
        if message:
            status[row] = RAISED
            for array in arrays.values():
                array[row] = np.nan
            continue
        for name in ("rayleigh", "marechal"):
            arrays[name][row] /= instants[row]
        if "exposure" in arrays:
            with clock("image"):
                found = exposed(bench, gathered.pop(row), instants[row], draws[row])
                exposures[row] = found["exposure"]
                add_energies(bench, arrays, exposures, _TOGETHER)
            for name, values in found.items():
                arrays[name][row] = values
    with clock("image"):
        add_energies(bench, arrays, exposures, 1)
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def _record(
    bench: Bench, arrays: dict[str, Array], piece: Piece, there: slice, wavefront: Wavefront, drawn: CaseDraw
) -> None:
    """Write a piece's numbers to the instants `there` of its case that it stands for."""
    row, here = piece.row, piece.here
    to_nm = bench.wavelength_nm
    to_mas = MAS_PER_RAD / bench.first_order.focal_length
    arrays["time_s"][row, there] = drawn.time[there]
    arrays["wfe_rms"][row, there] = wavefront.rms[here] * to_nm
    arrays["wfe_rms_raw"][row, there] = wavefront.rms_raw[here] * to_nm
    arrays["wfe_pv"][row, there] = wavefront.pv[here] * to_nm
    arrays["spot_rms"][row, there] = wavefront.spot_rms[here] * abs(to_mas)
    arrays["vignetted"][row] = max(arrays["vignetted"][row], wavefront.vignetted[here].max())
    arrays["rayleigh"][row] += np.count_nonzero(meets_rayleigh(wavefront.pv[here]))
    arrays["marechal"][row] += np.count_nonzero(meets_marechal(wavefront.rms_flat[here]))
    arrays["zernike"][row, there] = in_basis(bench, wavefront.zernike[here]) * to_nm
    arrays["los"][row, there] = (wavefront.los[here] - bench.static.los[0]) * to_mas
    arrays["centroid"][row, there] = (wavefront.centroid[here] - bench.static.centroid[0]) * to_mas
    arrays["strehl"][row, there] = wavefront.strehl[here]
    along_normal = drawn.motion.segment_motion[there, :, 2]
    arrays["segment_piston_rms"][row, there] = np.sqrt(np.mean(along_normal**2, axis=1)) * 1e9
    if "segment_motion" in arrays:
        arrays["segment_motion"][row, there] = drawn.motion.segment_motion[there]


def describe(bench: Bench) -> dict[str, str]:
    """Return what the disturbances amount to by their parameters alone, for the plan."""
    units = {"mas": "mas rms line of sight", "nm": "nm rms piston per segment"}
    known = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    rays = f"{len(bench.prepared.weight)} on {len(bench.system.segments)} segments"
    bodies = standing(bench.bodies.plants)
    return {"rays": rays, **bodies, **sampling_plan(bench.text).words()} | {
        name: f"{value[0]:.3g} {units[value[1]]}" for name, value in known.items() if value
    }


def work(bench: Bench, cases: int) -> dict[str, tuple[float, str]]:
    """Return the number of ray-surfaces traced for `cases` cases (padding of the instants included).

    By the modal model, it is the number of segments at an instant instead.
    """
    populations, shares = bench.study.disturbance, sum(entry.share for entry in bench.study.disturbance)
    if bench.study.optics.light == "modal":
        instants = cases * sum(entry.share * entry.instants for entry in populations) / shares
        return dict.fromkeys(("draw", "modal"), (instants * len(bench.system.segments), "segment-instants"))
    instants = cases * sum(entry.share * padded(entry.instants) for entry in populations) / shares
    optics, surfaces = bench.study.optics, 1 + len(bench.system.after_primary)
    rays = len(bench.prepared.weight) * len(optics.points_arcmin) * len(optics.colors_nm)
    return {"trace": (instants * rays * surfaces, "ray-surfaces")}


def check(study: SegmentStudy) -> None:
    """Raise UserError if the telescope at rest has no image, or a disturbance does not fit its mirror."""
    require_focus(study)  # soon; all else takes a while
    study_text = study.identity_text()
    bench = bench_of(study_text)
    if any(isinstance(entry, edge_sensors.EdgeSensorNoise) for entry in bench.study.disturbance):
        edge_sensors.shared_edges(bench.layout)  # says that there are none
    sampling_plan(study_text)
    if bench.study.rare is not None:
        rare_cases(study_text)
    if bench.study.imaging.enabled:
        for one in benches_of(study_text):
            refuse_what_cannot_be_imaged(one)
        require_pixels(camera_of(bench))
        if (shown := bench.study.object) is not None:
            check_object(shown, bench.study.imaging.pixels, bench.study.imaging.sampling)
    if bench.study.optics.light == "modal":
        require_all_rays(bench.stopped, "so that the modal model has no derivatives (optics.light)")
        model_of(study_text, choose_device("auto").name)
    populations = bench.study.disturbance
    for population in populations:  # where a draw is quick, or may act on what there is not
        of_bodies = any(isinstance(part, PlantSource) for part in parts(populations, population))
        if of_bodies or monolithic(bench.system):
            draw_case(populations, population, bench.layout, bench.study.study.seed, 0)


def notices(study: SegmentStudy) -> Iterator[str]:
    """Yield what to say of keys without effect, of light that mirrors stop, of too few rays for images."""
    bench = prepare(study)
    yield from bench.study.unused_keys(monolithic(bench.system))
    if bench.study.rare is not None:
        yield "Cases are drawn near a limit: their statistics are those of wavequake rare, by their weights"
    for one in benches_of(bench.text):
        if words := one.stopped.words():
            yield f"{words}{' from ' * bool(one.where)}{one.where}"
    for entry in bench.study.disturbance:
        if isinstance(entry, edge_sensors.EdgeSensorNoise) and (
            count := edge_sensors.unseen_motions(entry, bench.layout)
        ):
            yield (
                f"Besides piston, tip and tilt of the whole mirror, the sensors of {entry.name} do not see "
                f"{count} motion{'s' * (count > 1)} of its segments, which are not in its numbers"
            )
    yield from coarse_figures(bench)
    yield from ray_notices(bench)
    yield from frame_notices(bench)


KIND = study_kind(
    "segment-disturbance",
    SegmentStudy,
    prepare=prepare,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    work=work,
    check=check,
    notices=notices,
    memory=memory,
    compared=("disturbance", "reduction"),
)
