"""The study tmt-ao, small, for tests of loops on telescopes."""

from pathlib import Path

import numpy as np
from tests.workflows.small_disc import DISC

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.loops.light import Light
from wavequake.optics.segments.catalog import telescope
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.segments.bench import layout_of

SMALL = {
    "optics.rays": 300,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    **DISC,
    "controller.body-perfect.modes": 12,
    "controller.body.modes": 12,
    "disturbance.history.instants": 50,
    "imaging.pixels": 16,
    "look.traced": 4,
    "campaign.cases": 2,
    "controller.rigid.vary": {"bandwidth_hz": [60], "latency_frames": [0.5]},
    "controller.elastic.vary": {"bandwidth_hz": [60], "latency_frames": [0.5]},
    "controller.body.vary": {"bandwidth_hz": [60], "latency_frames": [0.5]},
    "controller.elastic-faint.vary": {"bandwidth_hz": [60]},
    "controller.elastic-lqg.vary": {"latency_frames": [0.5]},
}
LIGHT = Light(28, 0.3, 15000.0, layout_of(telescope("tmt-18")))


def small(**changes):
    return wq.load_study("tmt-ao", SMALL | changes)


def written(path, more, changes=None):
    """Return the small study with more text at the end of its file."""
    path = path / "study.toml"
    path.write_text((Path(__file__).parents[2] / "workflows" / "tmt-ao.toml").read_text() + more)
    return wq.load_study(path, SMALL | (changes or {}))


def table(bench, count):
    ids = np.arange(count)
    return {"case": ids, **telescope_loop.cases(bench.study, ids)}


def first_case(study):
    bench = bench_of(study)
    (block,) = telescope_loop.compute(bench, table(bench, 1), "numpy", Stopwatch())
    los = np.sqrt((block.result["los"] ** 2).sum(axis=-1).mean(axis=-1))[0]
    wfe = np.sqrt((block.result["wfe_rms"] ** 2).mean(axis=-1))[0]
    names = [one.name for one in bench.controllers]
    return bench, block, dict(zip(names, los, strict=True)), dict(zip(names, wfe, strict=True))
