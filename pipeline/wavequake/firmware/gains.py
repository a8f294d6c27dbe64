"""Gains of the modal regulator as a C header, in float, 32-bit or 16-bit arithmetic.

Steps are kept as their difference from one, so that few bits hold a slow decay; each group of coefficients
(steps, gains, row) has the largest power of two as its scale that its arithmetic can bear.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.errors import UserError

Array = NDArray[np.float64]

VARIANTS = ("float", "q31", "q16")
# Bits of the converter of commands, and full scale of states as a multiple of the converters' reach.
CODE_BITS = 12
HEADROOM = 4.0
# Integer states are below 2**STATE_BITS; sums of them bear so many modes.
STATE_BITS = 30
MOST_MODES = 15


@dataclass(frozen=True)
class Arithmetic:
    """What the integers of a variant can hold.

    Attributes
    ----------
    largest : int
        Of a coefficient.
    row_sum : int
        Of the row's magnitudes, the middle code included.
    shifts : dict
        Smallest and largest binary scale of each group of coefficients.
    """

    largest: int
    row_sum: int
    shifts: dict[str, tuple[int, int]]


INTEGERS = {
    "q31": Arithmetic(
        2**31 - 1,
        2**33,
        {"step": (31, 32), "gain": (31, 32), "row": (31, 63 - CODE_BITS)},
    ),
    "q16": Arithmetic(
        2**15 - 1,
        2**17 - 3,
        {"step": (16, 47), "gain": (15, 47), "row": (16, 47 - CODE_BITS)},
    ),
}


@dataclass(frozen=True)
class Gains:
    """Numbers of a header: of the named arithmetic, in its scales.

    Attributes
    ----------
    variant : str
    digest : str
        Of the regulator, the sensor chain and the arithmetic.
    sample_time, reach : float
        s, m.
    modes : ndarray, shape (m, 6)
        Step less one, gain, conjugate row: real and imaginary parts.
    starts : ndarray, shape (k, m, 2)
        Added after the trigger.
    shifts : tuple of int
        Binary scales of steps, gains and row; zeros for float.
    reading : float
        State per unit of 2 code - top.
    chain : SensorChain
    """

    variant: str
    digest: str
    sample_time: float
    reach: float
    modes: Array
    starts: Array
    shifts: tuple[int, int, int]
    reading: float
    chain: SensorChain


def gains_of(regulator: ModalRegulator, chain: SensorChain, variant: str = "q31") -> Gains:
    """Scale and round a regulator for the firmware.

    Raises
    ------
    UserError
        If a number is not finite or beyond the range of the arithmetic (says which, and the range), the
        arithmetic is not known, or the sample time is no whole number of microseconds.
    """
    if variant not in VARIANTS:
        raise UserError(f"There is no arithmetic {variant!r}; there are {', '.join(VARIANTS)}.")
    _check(regulator, chain)
    unit = (2**CODE_BITS - 1) / (2 * chain.reach)
    groups = {"step": regulator.step - 1, "gain": regulator.gain, "row": regulator.row.conj() * unit}
    full = HEADROOM * chain.reach
    top = 2**chain.adc_bits - 1
    starts = _pairs(regulator.start)
    digest = _digest(regulator, chain, variant)
    if variant == "float":
        modes = np.hstack([_pairs(values) for values in groups.values()])
        reading = chain.reach / top
        return Gains(
            variant, digest, regulator.sample_time, chain.reach, modes, starts, (0, 0, 0), reading, chain
        )
    if len(regulator.step) > MOST_MODES:
        raise UserError(f"The regulator has {len(regulator.step)} modes; {variant} bears {MOST_MODES}.")
    state = full / 2**STATE_BITS
    groups["row"] = groups["row"] * state
    columns, shifts = [], []
    for name, values in groups.items():
        shift = _shift(name, values, variant)
        columns.append(np.rint(np.ldexp(_pairs(values), shift)))
        shifts.append(shift)
    started = np.rint(starts / state)
    if np.abs(started).max() >= 2**STATE_BITS:
        raise UserError(f"The blow moves a mode by more than {1e3 * full:g} mm, the full scale of {variant}.")
    return Gains(
        variant,
        digest,
        regulator.sample_time,
        chain.reach,
        np.hstack(columns),
        started,
        (shifts[0], shifts[1], shifts[2]),
        float(np.rint(2**STATE_BITS / HEADROOM / top)),
        chain,
    )


def _pairs(values: NDArray[np.complex128]) -> Array:
    return np.stack([values.real, values.imag], axis=-1)


def _check(regulator: ModalRegulator, chain: SensorChain) -> None:
    named = {"step": regulator.step, "gain": regulator.gain, "row": regulator.row, "start": regulator.start}
    if not len(regulator.step):
        raise UserError("The regulator has no modes; the firmware needs at least one.")
    for name, values in named.items():
        if not np.isfinite(values).all():
            mode = int(np.argwhere(~np.isfinite(values))[0][-1]) + 1
            raise UserError(f"The {name} of mode {mode} is not finite; design the regulator anew.")
    growing = np.abs(regulator.step) >= 1
    if growing.any():
        mode = int(np.argmax(growing))
        raise UserError(
            f"The step of mode {mode + 1} has a magnitude of {abs(regulator.step[mode]):.4g}; the firmware "
            "bears modes that decay alone, below 1."
        )
    microseconds = regulator.sample_time * 1e6
    if not 100 <= microseconds <= 100_000 or abs(microseconds - round(microseconds)) > 1e-6:
        raise UserError(
            f"The sample time is {1e3 * regulator.sample_time:g} ms; the boards' timers need a whole number "
            "of microseconds from 0.1 to 100 ms."
        )
    if chain.adc_bits > 12 or chain.dac_bits != 10:
        raise UserError(
            f"Converters have {chain.adc_bits} and {chain.dac_bits} bits; the boards have 12 and 10."
        )
    if _edge_slope(chain) > 131_000:
        raise UserError(
            f"An edge of {1e6 * chain.edge:g} um is too long for the decoder at a reach of "
            f"{1e3 * chain.reach:g} mm; one edge may be at most two steps of the converter."
        )


def _shift(name: str, values: NDArray[np.complex128], variant: str) -> int:
    """Return the largest binary scale that the arithmetic can bear."""
    kind = INTEGERS[variant]
    lowest, highest = kind.shifts[name]
    for shift in range(highest, lowest - 1, -1):
        sizes = np.abs(np.rint(np.ldexp(_pairs(values), shift)))
        if name == "row":
            # Products are kept whole in 64 bits, or without their last 16 in 32 bits.
            middle = 2.0 ** (CODE_BITS - 1 + shift - STATE_BITS)
            fits = sizes.sum() + middle < kind.row_sum
        else:
            fits = name == "gain" or sizes.sum(axis=1).max() < 2.0**shift
        fits = fits and sizes.max() <= kind.largest
        if fits:
            return shift
    mode = int(np.argmax(np.abs(values)))
    unit = " steps of the converter per full scale" if name == "row" else ""
    scale = 2.0**STATE_BITS if name == "row" else 1.0
    limit = kind.largest / 2.0**lowest * scale
    raise UserError(
        f"The {name} of mode {mode + 1} is {abs(values[mode]) * scale:.4g}{unit}, beyond the range of "
        f"{variant}, which ends at {limit:.4g}; change the design or use float."
    )


def _edge_slope(chain: SensorChain) -> int:
    """Return the converter's steps per edge, times 2**16."""
    slope: float = chain.edge * (2**chain.dac_bits - 1) / (2 * chain.reach) * 2**16
    return round(slope)


def _digest(regulator: ModalRegulator, chain: SensorChain, variant: str) -> str:
    digest = hashlib.blake2b(digest_size=8)
    numbers = (regulator.sample_time, chain.edge, chain.reach, chain.dac_bits, chain.adc_bits)
    digest.update(f"1 {variant} {numbers}".encode())
    for values in (regulator.step, regulator.gain, regulator.row, regulator.start):
        digest.update(
            str(values.shape).encode() + np.ascontiguousarray(values, dtype=np.complex128).tobytes()
        )
    return digest.hexdigest()


def header(gains: Gains) -> str:
    """Return the text of wq_gains.h."""
    modes, starts, chain = gains.modes, gains.starts, gains.chain
    count, steps = len(modes), len(starts)
    whole = gains.variant != "float"
    state_full = HEADROOM * gains.reach
    lines = [
        "/* Generated by `wavequake firmware build`; do not edit. */",
        "#ifndef WQ_GAINS_H",
        "#define WQ_GAINS_H",
        f'#define WQ_HASH "{gains.digest}" /* of the design; images carry it */',
        f"#define WQ_{gains.variant.upper()}",
        f"#define WQ_SAMPLE_TIME_US {round(gains.sample_time * 1e6)}L",
        f"#define WQ_REACH_NM {round(gains.reach * 1e9)}L /* codes span -reach to reach */",
        f"#define WQ_EDGE_PM {round(chain.edge * 1e12)}LL /* travel of the sensor per edge */",
        f"#define WQ_ADC_TOP {2**chain.adc_bits - 1}",
        f"#define WQ_CODE_BITS {CODE_BITS}",
        f"#define WQ_CODE_TOP {2**CODE_BITS - 1}",
        f"#define WQ_CODE_MIDDLE {2 ** (CODE_BITS - 1)} /* half a step above no command, for rounding */",
        f"#define WQ_EDGE_SLOPE {_edge_slope(chain)}L /* decoder: steps of its converter per edge, Q16 */",
        f"#define WQ_EDGE_TOP {2**chain.dac_bits - 1}",
        f"#define WQ_EDGE_MIDDLE {2 ** (chain.dac_bits - 1)}",
        f"#define WQ_MODES {count}",
        f"#define WQ_STARTS {steps} /* steps in which a blow is added */",
        *(
            f"#define WQ_{name}_SHIFT {shift}"
            for name, shift in zip(("STEP", "GAIN", "ROW"), gains.shifts, strict=True)
            if whole
        ),
        *(
            (f"#define WQ_STATE_REACHES {HEADROOM:.0f}L /* full scale of states over reach */",)
            if whole
            else ()
        ),
        f"#define WQ_READING {_number(gains.reading, whole)} /* state per 2 code - top */",
        *(() if whole else (f"#define WQ_STATE_FULL {_number(state_full, False)} /* m */",)),
        "/* step - 1, gain, conjugate row of each mode: real and imaginary parts */",
        "#define WQ_MODE_LIST(X) \\",
        " \\\n".join(f"    X({', '.join(_number(v, whole) for v in row)})" for row in modes),
        "/* added to the modes in the steps from the trigger on */",
        "#define WQ_START_LIST(X) \\",
        " \\\n".join(
            f"    X({_number(real, whole)}, {_number(imaginary, whole)})"
            for real, imaginary in starts.reshape(-1, 2)
        ),
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _number(value: float, whole: bool) -> str:
    if whole:
        return f"{int(value)}L"
    return f"{float(np.float32(value)).hex()}f"
