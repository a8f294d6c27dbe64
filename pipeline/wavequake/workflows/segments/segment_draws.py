"""What a case of a segmented telescope draws: motions by generators, by a sampling plan, or near a limit."""

from wavequake.chain.sampling import Plan, plan_of
from wavequake.mechanics.disturbances.registry import Disturbance, Motion, draw_case
from wavequake.mechanics.disturbances.source import Source
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.segment_rare import rare_cases


@prepared(maxsize=2)
def sampling_plan(study_text: str) -> Plan:
    """Return what spreads the random numbers of the study with this identity text.

    Raises
    ------
    UserError
        If they are too many for the plan that the study asks for.
    """
    bench = bench_of(study_text)
    study = bench.study
    singles = [entry for entry in study.disturbance if isinstance(entry, Source)]

    def draw(streams: Streams) -> None:
        for entry in singles:
            draw_case(singles, entry, bench.layout, study.study.seed, 0, streams)

    return plan_of(
        study.campaign,
        study.study.seed,
        [entry.share for entry in study.disturbance],
        draw,
        singles,
    )


def draw_realization(bench: Bench, population: Disturbance, realization: int) -> Motion:
    """Draw a realization, which depends on the study, the population and its number only."""
    study = bench.study
    plan = sampling_plan(bench.text) if study.rare is None else rare_cases(bench.text)
    streams = plan.of(realization)
    return draw_case(study.disturbance, population, bench.layout, study.study.seed, realization, streams)
