"""Gains as integers: their values in C, and designs that no arithmetic can hold."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.firmware.build import BOARDS, compiler_of
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


SPOILED = {  # what a static assertion says, and what it finds in a header: (pattern, replacement)
    "as many modes as it says": [(r"    X\([^)]*\) \\\n", ""), (r"WQ_MODES 11", "WQ_MODES 10")],
    "a start of each mode": [(r"WQ_STARTS 8", "WQ_STARTS 7"), (r"WQ_STARTS 8", "WQ_STARTS 9")],
    "has 16 digits": [(r'WQ_HASH "....', 'WQ_HASH "')],
    "codes must be those of": [("WQ_CODE_TOP 4095", "WQ_CODE_TOP 1023")],
    "of its edge and reach": [
        ("WQ_REACH_NM 8000000L", "WQ_REACH_NM 5000000L"),
        ("WQ_EDGE_PM 13600000LL", "WQ_EDGE_PM 15000000LL"),
    ],
    "the reach of the converters": [(r"WQ_READING \d+", "WQ_READING 32778")],
    "adds to a state must be below full scale": [(r"X\(0L, 0L\)", "X(1073741825L, 0L)")],
    "the middle code must fit": [(r"WQ_ROW_SHIFT (\d+)", r"WQ_ROW_SHIFT 9\1")],
    "step": [(r"WQ_STEP_SHIFT (\d+)", "WQ_STEP_SHIFT 12")],
}


@pytest.mark.parametrize("variant", ["q31", "q16"])
@pytest.mark.parametrize("words", SPOILED)
def test_a_spoiled_header_does_not_compile(tmp_path, variant, words):
    """Static assertions hold the header's numbers, counts, units and hash against each other.

    (gnu99, because glibc replaces the keyword in strict C99, and its messages are lost.)
    """
    text = header(gains_of(REGULATOR, CHAIN, variant))
    (tmp_path / "wq_gains.h").write_text(text)
    core = folder("firmware") / "core"
    try:
        command = [*compiler_of(BOARDS["host"]), "-std=gnu99", f"-I{tmp_path}", f"-I{core}"]
    except UserError as error:  # says which package is missing
        pytest.skip(str(error))
    # Compiled for good: zig cannot check the syntax alone.
    command += [
        *(str(core / name) for name in ("control.c", "quadrature.c")),
        "-o",
        str(tmp_path / "core.so"),
    ]
    subprocess.run(command, check=True)
    for pattern, other in SPOILED[words]:
        spoiled, count = re.subn(pattern, other, text, count=1)
        assert count == 1
        (tmp_path / "wq_gains.h").write_text(spoiled)
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode != 0
        assert words in done.stderr


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
            "gain of mode 6 .* beyond the range of q31, which ends at 1",
        ),
        ({"gain": REGULATOR.gain * 3}, "q16", "gain of mode 6 .* beyond the range of q16, which ends at 1"),
        ({"row": REGULATOR.row * 1e6}, "q16", "row of mode 5 .* beyond the range of q16"),
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
