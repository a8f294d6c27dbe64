"""The workflow ``segment-disturbance``: Monte Carlo of disturbed segments and line of sight.

One case is one realization of one population of disturbances over its instants: motions of segments and M2
are drawn (`mechanics`), every instant is ray traced and its wavefront measured (`kernels`, `optics`), and the
instants' point spread functions make the case's exposure (`imaging`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, StudyKind
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.sampling import replicate_labels
from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import (
    Disturbance,
    Motion,
    analytic_rms,
    draw_case,
    instants_of,
)
from wavequake.mechanics.disturbances.sources.edge_sensors import EdgeSensorNoise, unseen_motions
from wavequake.optics.polynomials.zernike import noll_to_nm
from wavequake.optics.segments.kinematics import in_optics_frame
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.states import SurfaceStates, rest
from wavequake.optics.segments.wavefront import Wavefront, analyse
from wavequake.optics.wavefronts.quality import meets_marechal, meets_rayleigh
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench, bench_of, in_basis, monolithic
from wavequake.workflows.segments.case_pattern import slots
from wavequake.workflows.segments.images import (
    energy_scale,
    ray_notices,
    refuse_what_cannot_be_imaged,
    summed_images,
)
from wavequake.workflows.segments.segment_draws import draw_realization, sampling_plan
from wavequake.workflows.segments.segment_modal import modal_cases
from wavequake.workflows.segments.segment_model import model_of
from wavequake.workflows.segments.segment_rare import rare_cases
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.segments.segment_template import template, traced
from wavequake.workflows.segments.vignetting import require_all_rays

Array = NDArray[np.float64]

# Tiles per launch: about 40 MB per output array at 9000 rays, however many and long the cases are.
_LAUNCH_TILES = 32


@dataclass(frozen=True)
class CaseDraw:
    """One case before optics: its population, realization, time axis (n,) in s and motion."""

    population: Disturbance
    realization: int
    time: Array
    motion: Motion


Kind = TypeVar("Kind", bound=Population)


def slot(populations: tuple[Kind, ...], case: int) -> tuple[Kind, int]:
    """Return the population and realization of a case, see `case_pattern.slots`."""
    which, realization = slots([population.share for population in populations], np.array([case]))
    return populations[which[0]], int(realization[0])


def draw(bench: Bench, case: int) -> CaseDraw:
    """Draw the motion of one case, which depends on seed, disturbance and realization only."""
    population, realization = slot(bench.study.disturbance, case)
    motion = draw_realization(bench, population, realization)
    return CaseDraw(population, realization, instants_of(bench.study.disturbance, population), motion)


def surface_states(bench: Bench, drawn: CaseDraw, first: int, last: int) -> SurfaceStates:
    """Convert instants first <= i < last from SI to the optics (mm), padded with rest to whole tiles."""
    states = _at_rest(bench, padded(last - first))
    _put(states, 0, bench, drawn, slice(first, last))
    return states


def _at_rest(bench: Bench, batch: int) -> SurfaceStates:
    states = rest(batch, len(bench.system.segments), len(bench.system.surfaces), bench.figure_terms)
    states.field[:] = bench.field
    return states


def _put(states: SurfaceStates, place: int, bench: Bench, drawn: CaseDraw, part: slice) -> None:
    """Write some instants of a case over instants at rest, from `place` on."""
    motion, here = drawn.motion, slice(place, place + part.stop - part.start)
    segments = states.segment_motion[here]
    segments[:] = motion.segment_motion[part]
    segments[..., :3] *= MM_PER_M
    states.segment_figure[here, :, : motion.segment_figure.shape[-1]] = motion.segment_figure * MM_PER_M
    states.surface_motion[here, 0, 3:5] = motion.m2[part] @ bench.m2_tilt.T
    for index, surface in enumerate(bench.system.surfaces):
        if surface.name in motion.rigid:
            own = motion.rigid[surface.name][part] * np.repeat([MM_PER_M, 1.0], 3)
            states.surface_motion[here, index] += in_optics_frame(own, surface.rotation)
    states.field[here] += motion.mount[part]


@dataclass(frozen=True)
class Piece:
    """Instants first <= i < last of the case in `row` of a chunk, and where in a launch they begin."""

    row: int
    first: int
    last: int
    place: int

    @property
    def here(self) -> slice:
        """Its instants in the launch."""
        return slice(self.place, self.place + self.last - self.first)


def _launches(draws: list[CaseDraw], instants: list[int]) -> Iterator[list[Piece]]:
    """Cut the cases, of each so many instants, into launches of at most _LAUNCH_TILES tiles.

    A case takes whole tiles of its own. Those of a single instant share tiles, each at the place that its
    realization gives it, whatever is beside it.
    """
    launch: list[Piece] = []
    tiles, shared = 0, dict[int, set[int]]()  # places that are taken of tiles that cases share
    for row, (drawn, count) in enumerate(zip(draws, instants, strict=True)):
        lane, first = drawn.realization % TILE, 0
        while first < count:
            free = next((tile for tile, taken in shared.items() if lane not in taken), tiles)
            if tiles == _LAUNCH_TILES and (count > 1 or free == tiles):
                yield launch
                launch, tiles, shared, free = [], 0, {}, 0
            if count == 1:
                launch.append(Piece(row, 0, 1, free * TILE + lane))
                shared.setdefault(free, set()).add(lane)
                tiles, first = max(tiles, free + 1), 1
                continue
            last = min(count, first + (_LAUNCH_TILES - tiles) * TILE)
            launch.append(Piece(row, first, last, tiles * TILE))
            tiles, first = tiles + padded(last - first) // TILE, last
    if launch:
        yield launch


def _traced_instants(drawn: CaseDraw) -> int:
    """Return how many instants of a case are traced: one of a case that stands still."""
    motion = drawn.motion
    series = (motion.segment_motion, motion.mount, motion.m2, *motion.rigid.values())
    return 1 if all((one == one[:1]).all() for one in series) else len(drawn.time)


def compute(study_text: str, cases: NDArray[np.int64], device_name: str) -> ChunkResult:
    """Compute the numbers of `cases` over their instants, by full traces or by the modal model."""
    if bench_of(study_text).study.optics.method == "modal":
        return modal_cases(study_text, cases, device_name, trace_cases)
    found = trace_cases(study_text, cases, device_name)
    if bench_of(study_text).study.rare is None:
        return found
    weights = rare_cases(study_text).labels(cases)  # one disturbance: the case is its realization
    return replace(found, arrays={**found.arrays, **weights})


def trace_cases(study_text: str, cases: NDArray[np.int64], device_name: str) -> ChunkResult:
    """Compute the numbers of `cases` over their instants by full traces.

    A case in which a segment loses all its rays, or is tilted beyond what can be imaged, is quarantined with
    the reason.
    """
    bench = bench_of(study_text)
    start = Stopwatch()
    with start("draw"):
        draws = [draw(bench, int(case)) for case in cases]
    return trace_draws(study_text, draws, device_name, start)


def trace_draws(
    study_text: str, draws: list[CaseDraw], device_name: str, clock: Stopwatch | None = None
) -> ChunkResult:
    """Trace motions that were drawn; as :func:`trace_cases`."""
    bench, device, clock = bench_of(study_text), choose_device(device_name), clock or Stopwatch()
    arrays = {
        name: np.full((len(draws), *variable.shape), np.nan, dtype=variable.dtype)
        for name, variable in traced(study_text).items()
    }
    for name in ("exposure", "rayleigh", "marechal", "vignetted"):  # gathered over a case's launches
        if name in arrays:
            arrays[name][:] = 0.0
    messages, instants = [""] * len(draws), [_traced_instants(drawn) for drawn in draws]
    for launch in _launches(draws, instants):
        with clock("draw"):
            states = _at_rest(bench, padded(max(piece.here.stop for piece in launch)))
            for piece in launch:
                _put(states, piece.place, bench, draws[piece.row], slice(piece.first, piece.last))
        with clock("trace"):
            rays = trace_states(bench.prepared, states, device)
        with clock("wavefront"):
            wavefront = analyse(bench.prepared, rays, chief_rays(bench.prepared, states), device)
        for piece in launch:
            row, drawn = piece.row, draws[piece.row]
            messages[row] = messages[row] or _lost_segment(bench, drawn, wavefront, piece)
            if messages[row]:
                continue
            whole = instants[row] == 1  # the piece stands for all instants
            there = slice(0, len(drawn.time)) if whole else slice(piece.first, piece.last)
            _record(bench, arrays, piece, there, wavefront, drawn)
            if "exposure" not in arrays:
                continue
            try:
                with clock("image"):
                    arrays["exposure"][row] += summed_images(bench, rays, wavefront, piece.here)
            except UserError as error:  # tilts that no image can be made of concern this case alone
                messages[row] = str(error)
    status = np.full(len(draws), DONE, dtype=np.int8)
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
                _finish_exposure(bench, arrays, row, instants[row])
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def _lost_segment(bench: Bench, drawn: CaseDraw, wavefront: Wavefront, piece: Piece) -> str:
    instants, segments = np.nonzero(wavefront.lost_segments[piece.here])
    if not len(instants):
        return ""
    instant, segment = piece.first + int(instants[0]), int(segments[0])
    return (
        f"segment {bench.system.segments.names[segment]} lost all its rays at instant {instant} "
        f"(t = {drawn.time[instant]:.4g} s): its motion takes its glass out of the beam"
    )


def _record(
    bench: Bench, arrays: dict[str, Array], piece: Piece, there: slice, wavefront: Wavefront, drawn: CaseDraw
) -> None:
    """Write a piece's numbers to the instants `there` of its case that it stands for."""
    row, here = piece.row, piece.here
    to_nm = bench.study.optics.wavelength_nm
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


def _finish_exposure(bench: Bench, arrays: dict[str, Array], row: int, instants: int) -> None:
    exposure = arrays["exposure"][row]
    exposure /= instants
    arrays["peak"][row] = exposure.max()
    radii = encircled_energy_radius(exposure, (0.5, 0.8), **energy_scale(bench))
    arrays["ee50"][row], arrays["ee80"][row] = radii


def case_table(study_text: str, first: int, last: int) -> dict[str, NDArray[np.generic]]:
    """Return the labels of cases first <= id < last: disturbance, realization and seed."""
    study = study_from_identity(SegmentStudy, study_text)
    which, realizations = slots([entry.share for entry in study.disturbance], np.arange(first, last))
    return {
        "disturbance": np.array([entry.name for entry in study.disturbance], dtype=object)[which],
        "realization": realizations,
        "seed": np.full(last - first, study.study.seed, dtype=np.int64),
        **replicate_labels(study.campaign, realizations),
    }


def describe(study_text: str) -> dict[str, str]:
    """Return what the disturbances amount to by their parameters alone, for the plan."""
    bench = bench_of(study_text)
    units = {"mas": "mas rms line of sight", "nm": "nm rms piston per segment"}
    known = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    rays = f"{len(bench.prepared.weight)} on {len(bench.system.segments)} segments"
    return {"rays": rays, **sampling_plan(study_text).words()} | {
        name: f"{value[0]:.3g} {units[value[1]]}" for name, value in known.items() if value
    }


def work(study_text: str, cases: int) -> dict[str, tuple[float, str]]:
    """Return the number of ray-surfaces traced for `cases` cases (padding of the instants included).

    By the modal model, it is the number of segments at an instant instead.
    """
    bench = bench_of(study_text)
    populations, segments = bench.study.disturbance, len(bench.system.segments)
    shares = sum(entry.share for entry in populations)
    if bench.study.optics.method == "modal":
        instants = cases * sum(entry.share * entry.instants for entry in populations) / shares
        return dict.fromkeys(("draw", "modal"), (instants * segments, "segment-instants"))
    instants = cases * sum(entry.share * padded(entry.instants) for entry in populations) / shares
    per_instant = len(bench.prepared.weight) * (1 + len(bench.system.surfaces))
    return {"trace": (instants * per_instant, "ray-surfaces")}


def check(study_text: str) -> None:
    """Raise UserError if the telescope at rest has no image, or a disturbance does not fit its mirror."""
    bench = bench_of(study_text)
    sampling_plan(study_text)
    if bench.study.rare is not None:
        rare_cases(study_text)
    if bench.study.imaging.enabled:
        refuse_what_cannot_be_imaged(bench)
    if bench.study.optics.method == "modal":
        require_all_rays(bench.stopped, "so that the modal model has no derivatives (optics.method)")
        model_of(study_text, choose_device("auto").name)
    if monolithic(bench.system):  # where every draw is quick
        for population in bench.study.disturbance:
            draw_case(bench.study.disturbance, population, bench.layout, bench.study.study.seed, 0)


def notices(study_text: str) -> Iterator[str]:
    """Yield what to say of keys without effect, of light that mirrors stop, of too few rays for images."""
    bench = bench_of(study_text)
    yield from bench.study.unused_keys(monolithic(bench.system))
    if bench.study.rare is not None:
        yield "Cases are drawn near a limit: their statistics are those of wavequake rare, by their weights"
    if words := bench.stopped.words():
        yield words
    for entry in bench.study.disturbance:
        if isinstance(entry, EdgeSensorNoise) and (count := unseen_motions(entry, bench.layout)):
            yield (
                f"Besides piston, tip and tilt of the whole mirror, the sensors of {entry.name} do not see "
                f"{count} motion{'s' * (count > 1)} of its segments, which are not in its numbers"
            )
    yield from _coarse_figures(bench)
    yield from ray_notices(bench)


# Highest degree of a figure whose rms over a hexagon so many rays give within 5 %.
_FIGURE_DEGREES = {6: 1, 18: 2, 36: 3, 72: 5}


def _coarse_figures(bench: Bench) -> Iterator[str]:
    """Yield what to say of figures that are too fine for the rays of a segment."""
    optics = bench.study.optics
    if optics.sampling != "segments" or monolithic(bench.system) or not bench.figure_terms:
        return
    degree, rays = noll_to_nm(bench.figure_terms)[0], optics.rays_per_segment
    if degree > _FIGURE_DEGREES[rays]:
        enough = [str(count) for count, most in _FIGURE_DEGREES.items() if degree <= most]
        remedy = f"optics.rays_per_segment = {enough[0]}" if enough else "optics.sampling = 'sunflower'"
        yield (
            f"{rays} rays per segment are too few for its figure of j = {bench.figure_terms}, whose rms they "
            f"may miss by more than 5 %; take {remedy}"
        )


KIND = StudyKind(
    "segment-disturbance", template, case_table, compute, describe, work, check, notices, model=SegmentStudy
)
