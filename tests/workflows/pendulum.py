"""A study kind as a plug-in: pendulums of a chosen length, struck at random, as measures of their swing."""

import numpy as np
from pydantic import Field

from wavequake.campaign.contract import Drawn
from wavequake.campaign.measured import Block, study_kind
from wavequake.campaign.measures import Axis, Measure
from wavequake.campaign.schema import Section, Study
from wavequake.errors import UserError
from wavequake.workflows.kinds import register

INSTANTS = 8


class PendulumSection(Section):
    lengths_m: tuple[float, ...] = Field(default=(0.25, 1.0), min_length=1, strict=False)
    breaks_at: float = 1e9
    wrong: str = ""


class PendulumStudy(Study):
    pendulum: PendulumSection = PendulumSection()


def prepare(study):
    if min(study.pendulum.lengths_m) <= 0.0:
        raise UserError("pendulum.lengths_m: lengths are above 0.")
    return study


def cases(study, ids):
    lengths = np.array(study.pendulum.lengths_m)
    return {"length_m": lengths[ids % len(lengths)], "realization": ids // len(lengths)}


def compute(bench, table, device, clock):
    if bench.pendulum.wrong == "raises":
        raise RuntimeError("the rope is torn")
    seed = bench.study.seed
    kick = np.array([np.random.default_rng([seed, int(one)]).normal() for one in table["realization"]])
    omega = np.sqrt(9.81 / table["length_m"])
    time = np.arange(INSTANTS) * 0.05
    with clock("swing"):
        angle = kick[:, None] / omega[:, None] * np.sin(omega[:, None] * time)
    broken = {
        row: f"the pendulum breaks at {one:.2f} rad/s"
        for row, one in enumerate(kick)
        if one > bench.pendulum.breaks_at
    }
    if bench.pendulum.wrong == "shape":
        angle = angle[:, :, None]
    return Block({"time": np.tile(time, (len(kick), 1)), "angle": angle, "omega": omega}, messages=broken)


def measures(bench):
    return [
        Measure("time_s", "s", "time of the instant", ("time",), lambda r: r["time"], coordinate=True),
        Measure("angle", "rad", "angle of the pendulum", ("time",), lambda r: r["angle"], over_time="max"),
        Measure("frequency", "Hz", "natural frequency", (), lambda r: r["omega"] / (2 * np.pi)),
    ]


def axes(bench):
    return {"time": Axis(INSTANTS)}


def pictures(bench, dataset):
    from matplotlib.figure import Figure

    yield Drawn("Swing", "the first case", Figure())


KIND = study_kind(
    "pendulum",
    PendulumStudy,
    prepare=prepare,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    pictures=pictures,
    compared=("length_m",),
)
register(KIND)
