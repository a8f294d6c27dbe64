"""Gains as integers: their values in C, and designs that no arithmetic can hold."""

import re
from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.gains import VARIANTS, gains_of, header

REGULATOR = design(fitted_bench(), Stage(), Settings()).regulator
CHAIN = SensorChain()


def defined(text, name):
    return re.search(rf"#define WQ_{name} (\S+)", text)[1].rstrip("L")


@pytest.mark.parametrize("variant", ["q31", "q16"])
def test_header_holds_the_regulator_in_its_scales(variant):
    text = header(gains_of(REGULATOR, CHAIN, variant))
    rows = re.search(r"WQ_MODE_LIST\(X\)(.*?)/\*", text, re.S)[1]
    numbers = np.array(
        [[int(v.strip(" L")) for v in row.split(",")] for row in re.findall(r"X\((.*?)\)", rows)]
    )
    scale = [2.0 ** int(defined(text, f"{name}_SHIFT")) for name in ("STEP", "GAIN", "ROW")]
    bits, full = 30, 4 * CHAIN.reach
    wanted = [
        REGULATOR.step - 1,
        REGULATOR.gain,
        REGULATOR.row.conj() * 4095 / (2 * CHAIN.reach) * full / 2**bits,
    ]
    for place, values in enumerate(wanted):
        stored = (numbers[:, 2 * place] + 1j * numbers[:, 2 * place + 1]) / scale[place]
        np.testing.assert_allclose(stored, values, rtol=0, atol=np.sqrt(0.5) / scale[place])
        # The scale is as large as it may be: the largest number uses the arithmetic's bits.
        assert np.abs(numbers[:, 2 * place : 2 * place + 2]).max() > 2 ** {"q31": 27, "q16": 12}[variant]


def test_float_header_holds_the_regulator_in_single_precision():
    text = header(gains_of(REGULATOR, CHAIN, "float"))
    rows = re.search(r"WQ_MODE_LIST\(X\)(.*?)/\*", text, re.S)[1]
    first = [float.fromhex(v.strip(" f")) for v in re.findall(r"X\((.*?)\)", rows)[0].split(",")]
    step = REGULATOR.step[0] - 1
    np.testing.assert_allclose(first[:2], [step.real, step.imag], rtol=1e-7)


def test_hash_tells_designs_apart():
    digests = {gains_of(REGULATOR, CHAIN, variant).digest for variant in VARIANTS}
    digests.add(gains_of(replace(REGULATOR, gain=REGULATOR.gain * (1 + 1e-12)), CHAIN).digest)
    digests.add(gains_of(REGULATOR, replace(CHAIN, edge=13.7e-6)).digest)
    assert len(digests) == 5
    assert gains_of(REGULATOR, CHAIN).digest in digests


@pytest.mark.parametrize(
    ("change", "variant", "words"),
    [
        (
            {"gain": REGULATOR.gain * 1e5},
            "q31",
            "gain of mode 5 .* beyond the range of q31, which ends at 1",
        ),
        ({"gain": REGULATOR.gain * 3}, "q16", "gain of mode 5 .* beyond the range of q16, which ends at 1"),
        ({"row": REGULATOR.row * 1e6}, "q16", "row of mode 4 .* beyond the range of q16"),
        ({"step": REGULATOR.step * 3}, "q31", "step of mode 1 has a magnitude of 3"),
        ({"start": REGULATOR.start * 1e3}, "q31", "full scale"),
        ({"gain": REGULATOR.gain * np.nan}, "float", "gain of mode 1 is not finite"),
        ({"start": REGULATOR.start + np.inf}, "float", "start of mode 1 is not finite"),
        ({"sample_time": 0.0020003}, "q31", "microseconds"),
        ({"step": REGULATOR.step[:0]}, "q31", "no modes"),
        ({}, "q7", "no arithmetic 'q7'"),
    ],
)
def test_designs_out_of_range_are_refused(change, variant, words):
    with pytest.raises(UserError, match=words):
        gains_of(replace(REGULATOR, **change), CHAIN, variant)


def test_decoder_refuses_edges_longer_than_its_converter_can_show():
    with pytest.raises(UserError, match="edge of 40 um"):
        gains_of(REGULATOR, SensorChain(edge=40e-6))
