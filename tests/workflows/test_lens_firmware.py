"""The firmware in the loop on the engine: bits, hashes, double precision, machines without a compiler."""

import sys

import numpy as np
import pytest

from wavequake import cli
from wavequake.campaign.contract import DONE, RAISED
from wavequake.control.experiment import CONTROLLERS
from wavequake.errors import UserError
from wavequake.firmware import kept
from wavequake.firmware.build import BOARDS, compiler_of, image_hash
from wavequake.firmware.gains import gains_of
from wavequake.workflows.lens.experiment import KIND, chain_of, designs_of, study_of
from wavequake.workflows.run import run
from wavequake.workflows.study import load_study

ARITHMETIC = ("float", "q31", "q16")
SHORT = ["time.duration_s=2.0"]
TEXT = load_study("lens-firmware", SHORT).identity_text()

try:
    compiler_of(BOARDS["host"])
except UserError as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    place = tmp_path_factory.mktemp("images")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept, "image_folder", lambda: place)
        yield place


@pytest.fixture(scope="module")
def chunk():
    return KIND.compute(TEXT, np.arange(4), "numpy")


def test_bits_of_a_case_do_not_depend_on_its_chunk(chunk):
    alone = KIND.compute(TEXT, np.array([3]), "numpy")
    assert set(alone.arrays) == set(KIND.template(TEXT).per_case)
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(values[0], chunk.arrays[name][3], err_msg=name)


def test_firmware_changes_nothing_of_the_other_controllers(chunk):
    without = KIND.compute(load_study("lens-experiment", SHORT).identity_text(), np.arange(4), "numpy")
    assert "firmware_hash" not in without.arrays
    np.testing.assert_array_equal(chunk.arrays["image"][:, : len(CONTROLLERS)], without.arrays["image"])


def test_hashes_are_those_of_images_that_were_run(chunk, cache):
    built = {image_hash(path) for path in cache.rglob("*.so")}
    stored = [[f"{int(one):016x}" for one in row] for row in chunk.arrays["firmware_hash"]]
    study = study_of(TEXT)
    for row, springs in enumerate(("initial", "changed") * 2):
        regulator = designs_of(TEXT, springs).regulator
        assert stored[row] == [gains_of(regulator, chain_of(study), one).digest for one in ARITHMETIC]
        assert set(stored[row]) <= built
    assert stored[0] == stored[2] != stored[1]


def test_each_arithmetic_does_what_double_precision_does(chunk):
    arrays, modal = chunk.arrays, CONTROLLERS.index("modal")
    assert (chunk.status == DONE).all()
    step = 16e3 / 4095
    for place in range(3):
        command = arrays["command"][:, len(CONTROLLERS) + place].astype(float)
        off = 1e3 * (command - arrays["command"][:, modal])
        # Commands are numbers of one converter, and differ where a sum lies close to its edge.
        largest, spread = (arrays[f"firmware_{key}"][:, place] for key in ("difference", "rms"))
        np.testing.assert_allclose(np.abs(off).max(axis=1), largest, rtol=0, atol=1e-3)
        np.testing.assert_allclose(np.sqrt((off**2).mean(axis=1)), spread, rtol=0, atol=1e-3)
        assert largest.max() < 1.01 * step
    rms = arrays["firmware_rms"].mean(axis=0)
    assert rms[0] < 0.15
    assert 0.3 < rms[2] < 2.0  # 16-bit coefficients show
    left = arrays["peak_to_peak"]
    assert np.abs(left[:, len(CONTROLLERS) :] - left[:, [modal]]).max() < 0.2


def test_identified_plants_run_images_of_their_own():
    more = ["firmware.design='identified'", "firmware.arithmetic=['q16']", "bench.springs=['initial']"]
    found = KIND.compute(load_study("lens-firmware", [*SHORT, *more]).identity_text(), np.arange(2), "numpy")
    assert len(set(found.arrays["firmware_hash"].ravel())) == 2
    exact = CONTROLLERS.index("identified")
    assert np.abs(found.arrays["peak_to_peak"][:, -1] - found.arrays["peak_to_peak"][:, exact]).max() < 0.2
    assert found.arrays["peak_to_peak"][:, -1].max() < 5


def test_a_store_holds_the_hashes(tmp_path):
    dataset = run("lens-firmware", cases=2, store=tmp_path / "s", time__duration_s=2.0)
    assert list(dataset["controller"].to_numpy())[-3:] == [f"firmware-{one}" for one in ARITHMETIC]
    assert dataset["firmware_hash"].dtype == np.uint64
    digest = gains_of(designs_of(TEXT, "initial").regulator, chain_of(study_of(TEXT)), "q31").digest
    assert f"{int(dataset['firmware_hash'].sel(firmware='q31')[0]):016x}" == digest


def test_gains_out_of_range_are_refused_before_a_store_is_made():
    soft = load_study("lens-firmware", ["stage.gain=1e-6"])
    with pytest.raises(UserError, match="beyond the range of q31"):
        KIND.check(soft.identity_text())


def test_a_plant_whose_gains_are_out_of_range_is_quarantined_alone(monkeypatch):
    from wavequake.firmware import units

    calls = iter(range(100))

    def failing(regulator, chain, arithmetic):
        if next(calls) in (1, 3):
            raise UserError("The gain of mode 1 is beyond the range of q31.")
        return gains_of(regulator, chain, arithmetic)

    monkeypatch.setattr(units, "gains_of", failing)
    one = ["firmware.arithmetic=['q31']", "bench.springs=['initial']"]
    text = load_study("lens-firmware", [*SHORT, *one]).identity_text()
    found = KIND.compute(text, np.arange(2), "numpy")
    assert list(found.status) == [DONE, RAISED]
    assert "beyond the range" in found.messages[1]
    assert list(found.arrays["firmware_hash"][:, 0] == 0) == [False, True]


def test_a_machine_without_compiler_is_told_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("wavequake.firmware.build.find_spec", lambda name: None)
    words = ["wavequake", "run", "lens-firmware", "campaign.cases=2", "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    said = capsys.readouterr()
    assert "ziglang from PyPI (extra firmware)" in " ".join((said.out + said.err).split())
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("firmware.arithmetic=['q7']", r"firmware\.arithmetic"),
        ("firmware.arithmetic=['q31', 'q31']", "listed twice"),
        ("firmware.design='best'", r"firmware\.design"),
    ],
)
def test_bad_keys_are_named(override, words):
    with pytest.raises(UserError, match=words):
        load_study("lens-firmware", [override])
