"""Rays of points of the stop that Newton's iteration does not find at once, and where light ends beyond them.

A point is approached from the chief ray's along a straight line, in steps as short as they have to be. Where
the line leaves what light reaches, a scan of the incoming beam shows where else to start. A point of which
neither finds a ray has none: its light ends where that next to the last ray does which goes towards it.
"""

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import MISS, OK
from wavequake.optics.rays.stop_map import AIMED, Aim, determinant, newton, solved

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = NDArray[np.int8]

_FIRST, _SHORTEST = 0.25, 2.0**-8  # steps along the line from the chief ray's point, as a share of it
_ROUNDS = 60
_CORRECTIONS = 4
_CLOSE = 1e-6  # how near to a point on the line a ray must be for the next step, as a share of its length
_SCANNED = 4.0  # half width of the scan, in radii of the beam
_SCANS = 101
_NEAR = 2.0  # distance of a scanned ray that is worth a start, in steps of the scan
_LADDER = 2.0 ** np.arange(-14.0, 4.0)  # how far to look for lost neighbors, in radii of the beam
_BISECTIONS = 24


def search(aim: Aim, chief: Array, target: Array, beam: float) -> tuple[Array, Mask]:
    """Return numbers of rays that meet the target (2, N), and which do; others are the last towards it.

    A point that light reaches on several ways has the ray that is connected with the chief ray, or one of the
    same orientation.

    Parameters
    ----------
    aim : Aim
    chief : ndarray, shape (2, 1)
        Numbers of the ray through the center of the stop.
    target : ndarray, shape (2, N)
    beam : float
        Radius of the beam, as the numbers measure it.
    """
    sign = float(np.sign(determinant(aim.meet_with_slopes(chief)[1])[0]))
    numbers, arrived = _continued(aim, chief, target, sign)
    left = np.flatnonzero(~arrived)
    if left.size:
        found, met = _scanned(aim, chief, target[:, left], sign, beam)
        numbers[:, left[met]] = found[:, met]
        arrived[left[met]] = True
    return numbers, arrived


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _continued(aim: Aim, chief: Array, target: Array, sign: float) -> tuple[Array, Mask]:
    """Follow the lines from the center to the targets; return the last numbers, and which arrived."""
    numbers = np.repeat(chief, target.shape[1], axis=1)
    reached, step = np.zeros(target.shape[1]), np.full(target.shape[1], _FIRST)
    grows = np.ones(target.shape[1], dtype=np.bool_)  # after two good steps in turn
    close = np.maximum(_CLOSE * np.max(np.abs(target), axis=0), AIMED)
    for _ in range(_ROUNDS):
        going = np.flatnonzero((reached < 1.0) & (step >= _SHORTEST))
        if not going.size:
            break
        ahead = np.minimum(reached[going] + step[going], 1.0)
        goal, trial = ahead * target[:, going], numbers[:, going]
        for _ in range(_CORRECTIONS):
            met, slopes = aim.meet_with_slopes(trial)
            trial = trial + solved(slopes, goal - met)
        met, slopes = aim.meet_with_slopes(trial)
        good = (np.max(np.abs(met - goal), axis=0) <= close[going]) & (sign * determinant(slopes) > 0.0)
        numbers[:, going[good]] = trial[:, good]
        reached[going[good]] = ahead[good]
        step[going] *= np.where(good & grows[going], 2.0, np.where(good, 1.0, 0.5))
        grows[going] = good
    there = np.flatnonzero(reached == 1.0)
    arrived = np.zeros(target.shape[1], dtype=np.bool_)
    if there.size:
        numbers[:, there] = newton(aim, numbers[:, there], target[:, there])
        arrived[there] = _meets(aim, numbers[:, there], target[:, there], sign)
    return numbers, arrived


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _scanned(aim: Aim, chief: Array, target: Array, sign: float, beam: float) -> tuple[Array, Mask]:
    """Start from rays of a scan that come near the targets; return numbers, and which arrived."""
    steps = np.linspace(-_SCANNED, _SCANNED, _SCANS) * beam
    scan = chief + np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    met = aim.meet(scan).reshape(2, _SCANS, _SCANS)
    across, up = (np.diff(met, axis=axis)[:, : _SCANS - 1, : _SCANS - 1] for axis in (2, 1))
    alike = np.zeros((_SCANS, _SCANS), dtype=np.bool_)
    alike[:-1, :-1] = sign * (across[0] * up[1] - across[1] * up[0]) > 0.0  # not where a neighbor is lost
    numbers = np.repeat(chief, target.shape[1], axis=1)
    arrived = np.zeros(target.shape[1], dtype=np.bool_)
    if alike.any():
        away, nearest = scipy.spatial.KDTree(met[:, alike].T).query(target.T)
        nearest[np.isinf(away)] = 0  # its square overflows, and none is the nearest
        size = np.sqrt(np.sum(across**2 + up**2, axis=0))[alike[:-1, :-1]][nearest]
        worth = np.flatnonzero(away <= _NEAR * size)
        if worth.size:
            start = scan[:, alike.ravel()][:, nearest[worth]]
            numbers[:, worth] = newton(aim, start, target[:, worth])
            arrived[worth] = _meets(aim, numbers[:, worth], target[:, worth], sign)
    return numbers, arrived


def _meets(aim: Aim, numbers: Array, target: Array, sign: float) -> Mask:
    met, slopes = aim.meet_with_slopes(numbers)
    return np.asarray((np.max(np.abs(met - target), axis=0) <= AIMED) & (sign * determinant(slopes) > 0.0))


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def ends(aim: Aim, numbers: Array, target: Array, beam: float, openings: bool) -> tuple[Numbers, Numbers]:
    """Return why, and at which surface, light ends that would have to reach the targets (2, N).

    It is that of the first ray beyond the last one (`numbers`) on the way to its target which is lost. With
    `openings`, light that an opening stops before ends there. A point beside which no light is lost, at a
    caustic, is missed by light that reaches the stop.
    """
    met, slopes = aim.meet_with_slopes(numbers)
    way = solved(slopes, target - met)
    way = np.where(np.isfinite(way).all(axis=0), way, target)
    way = way / np.maximum(np.sqrt(np.sum(way**2, axis=0)), np.finfo(float).tiny) * beam
    trials = numbers[:, :, None] + way[:, :, None] * _LADDER
    lost = np.isnan(aim.meet(trials.reshape(2, -1))[0]).reshape(-1, _LADDER.size)
    edge = lost.any(axis=1)
    first = np.argmax(lost, axis=1)
    low, high = np.where(first > 0, _LADDER[first - 1], 0.0), _LADDER[first]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        beyond = np.isnan(aim.meet(numbers + middle * way)[0])
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    last = np.where(edge, numbers + high * way, numbers)
    traced = trace_sequence_numpy(aim.sequence, aim.bundle.rays(last), aim.poses, not openings)
    status, surface = traced.status[0].copy(), traced.surface[0].copy()
    here = status == OK
    status[here], surface[here] = MISS, len(aim.sequence.elements) - 1
    return status, surface
