"""Standard normal numbers that a counter addresses: any run of them at once, on a device or by NumPy."""

from functools import lru_cache

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import NUMPY, Device
from wavequake.kernels.device.program import aligned_empty, source
from wavequake.kernels.device.steps import Step, run_steps, vector_width

Array = NDArray[np.float64]

WORDS = 4
"""Numbers by each step of the counter."""

_GROUP = 64  # work-items


def normal_numbers(key: NDArray[np.uint64], before: int, steps: int, device: Device = NUMPY) -> Array:
    """Return the numbers (4 `steps`,) of as many steps of the counter, behind the first `before`.

    They are the normal quantiles of the uniform numbers of ``numpy.random.Philox`` (Salmon et al. 2011), by
    Wichura's algorithm AS 241 on a device. Devices agree to 2e-15, relatively; the bits of a number depend on
    its place and the device alone.

    Parameters
    ----------
    key : ndarray of uint64, shape (2,)
        Of the generator.
    before, steps : int
        Steps of the counter.
    device : Device
        Where to run.
    """
    if device.kind == "numpy":
        generator = np.random.Generator(np.random.Philox(counter=before, key=key))
        return normal_quantiles(generator.random(WORDS * steps))
    numbers = aligned_empty((WORDS * steps,))
    if not steps:
        return numbers
    constants = (("W", vector_width(device, np.dtype(np.float64), long=True)),)
    items = -(-steps // constants[0][1])
    arguments = (np.int32(steps), *np.asarray(key, np.uint64), np.uint64(before), "numbers")
    step = Step(_text(), "normals", constants, (1, items, 1), (1, _GROUP, 1), arguments)
    run_steps(device, [step], {}, {"numbers": numbers}, {})
    if not is_trusted(device, ("normals", constants)):

        def twin(pick: Pick) -> list[Array]:
            return [normal_numbers(key, before, steps)[pick]]

        compare_first(device, ("normals", constants), [numbers], twin, kind="numbers")
    return numbers


def normal_quantiles(uniform: Array) -> Array:
    """Return where the normal distribution is as large as numbers between 0 and 1, but never infinite.

    A number is taken for the middle of its interval of the 2^53 that a generator tells apart, and that of the
    nearer tail: quantiles are as exact at 1 as at 0.
    """
    middle = uniform - 0.5 + 2.0**-54
    return np.asarray(np.copysign(scipy.special.ndtri(0.5 - np.abs(middle)), middle), dtype=np.float64)


@lru_cache(maxsize=1)
def _text() -> str:
    return source("normals.cl")
