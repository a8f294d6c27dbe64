"""Small loops between instants, for tests of them."""

import numpy as np

from wavequake.control.frames.disturbance import joined, line
from wavequake.control.sampled.channel import (
    RIGID,
    Timing,
)
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sampled.run import Actuator, run, schedule
from wavequake.control.sampled.stability import (
    SampledLoop,
)

T = 0.002
LINES = joined([line(12.0, 0.2, 3.0), line(30.0, 0.2, 2.0)])


def timing(latency=0.0, integration=1.0, frames=1):
    return Timing(T, integration * T, frames, latency * frames * T)


def free(count, dynamics=RIGID, **limits):
    kept = {"stroke": np.full(count, np.inf), "slew": np.inf, "stuck": np.full(count, np.nan)}
    return Actuator(dynamics, **(kept | limits))


def scalar(gain, latency=0.0, dynamics=RIGID, **keys):
    loop = shared_filter(np.eye(1), integrator(gain, **keys))
    return SampledLoop(timing(latency), dynamics, np.eye(1), loop)


def run_one(loop, seen, looks):
    """Run one loop on what its sensor sees, (frames, m, cases)."""
    return run([loop], schedule([loop.timing], looks), [seen], len(looks))
