"""A study kind of known errors: means of exp(a x) by the midpoint rule, and sin in place of its argument."""

import numpy as np
from pydantic import Field

from wavequake.campaign.measured import Block, study_kind
from wavequake.campaign.measures import Axis, Measure
from wavequake.campaign.schema import Section, Study
from wavequake.workflows.kinds import register


class QuadratureOptics(Section):
    rays: int = Field(default=10, ge=1)
    light: str = "modal"


class QuadratureStudy(Study):
    optics: QuadratureOptics = QuadratureOptics()


def cases(study, ids):
    return {"disturbance": np.where(ids % 2, "odd", "even"), "realization": ids // 2}


def slopes(table):
    return 1.0 + 0.5 * np.random.default_rng(3).random(1000)[table["realization"]]


def compute(study, table, device, clock):
    a, optics = slopes(table), study.optics
    x = (np.arange(optics.rays) + 0.5) / optics.rays
    angle = 0.1 * a
    return Block(
        {
            "mean": np.exp(np.outer(a, x)).mean(axis=1),
            "tilt": np.sin(angle) if optics.light == "traced" else angle,
        }
    )


def measures(study):
    yield Measure("mean", "nm", "mean of exp(a x)", (), lambda found: found["mean"])
    yield Measure("tilt", "mas", "sin a, or a", (), lambda found: found["tilt"])


def prepare(study):
    return study


def axes(study):
    return {"unused": Axis(1)}


parts = {"prepare": prepare, "cases": cases, "compute": compute, "measures": measures, "axes": axes}
register(study_kind("quadrature", QuadratureStudy, **parts))
