"""Images for the host are built once, whole, and never taken for those of other gains."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware import kept
from wavequake.firmware.build import BOARDS, build, compiler_of, image_hash
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import positions_of
from wavequake.firmware.units import FirmwareUnit

CHAIN = SensorChain()
REGULATOR = design(fitted_bench(), Stage(), Settings()).regulator
GAINS = gains_of(REGULATOR, CHAIN)

try:
    compiler_of(BOARDS["host"])
except UserError as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setattr(kept, "image_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def files(cache):
    return sorted(path for path in cache.rglob("*") if path.is_file())


def test_an_image_is_built_once(monkeypatch, cache):
    with kept.host_image(GAINS) as first:
        assert image_hash(first.path) == GAINS.digest
    monkeypatch.setattr(kept, "build", None)  # would raise
    with kept.host_image(GAINS) as second:
        assert second.path == first.path
    assert files(cache) == [first.path]


def test_other_gains_and_other_sources_are_other_images(monkeypatch, tmp_path):
    other = gains_of(replace(REGULATOR, gain=REGULATOR.gain * 1.01), CHAIN)
    command = compiler_of(BOARDS["host"])
    keys = {kept._key(GAINS, command), kept._key(other, command), kept._key(GAINS, (*command, "-g"))}
    sources = tmp_path / "firmware"
    for name in ("core/control.c", "boards/host/host.c"):
        (sources / name).parent.mkdir(parents=True)
        (sources / name).write_text("int x;")
    monkeypatch.setattr(kept, "folder", lambda name: sources)
    keys.add(kept._key(GAINS, command))
    (sources / "core/control.c").write_text("int y;")
    keys.add(kept._key(GAINS, command))
    assert len(keys) == 5


@pytest.mark.parametrize("damage", [b"", b"wavequake-gains:0123456789abcdef"])
def test_a_damaged_image_is_built_again(cache, damage):
    with kept.host_image(GAINS) as image:
        image.path.write_bytes(damage)
    with kept.host_image(GAINS) as image:
        assert image_hash(image.path) == GAINS.digest
        HostDevice(image).close()


def test_where_nothing_can_be_kept_images_are_built_all_the_same(cache):
    cache.write_text("a file where the folder would be")
    with kept.host_image(GAINS) as image:
        assert image_hash(image.path) == GAINS.digest
    assert not image.path.exists()


def test_what_is_not_kept_leaves_nothing(cache):
    with kept.host_image(GAINS, keep=False) as image:
        assert image.path.exists()
    assert not image.path.exists()
    assert not files(cache)


def test_processes_that_start_at_once_all_get_a_whole_image(cache):
    """Four build the same image into an empty cache at the same time and run it."""
    code = f"""
from pathlib import Path
import numpy as np
from wavequake.firmware import kept
from wavequake.firmware.units import FirmwareUnit
from tests_regulator import REGULATOR, CHAIN
kept.image_folder = lambda: Path({str(cache)!r})
commands = FirmwareUnit(CHAIN, "q31")(REGULATOR, np.full(50, 2100))
print(commands.tobytes().hex())
"""
    (cache.parent / "tests_regulator.py").write_text(
        "from wavequake.control.bench import fitted_bench\n"
        "from wavequake.control.experiment import Settings, design\n"
        "from wavequake.control.sensor import SensorChain\n"
        "from wavequake.control.stage import Stage\n"
        "CHAIN, REGULATOR = SensorChain(), design(fitted_bench(), Stage(), Settings()).regulator\n"
    )
    running = [
        subprocess.Popen([sys.executable, "-c", code], cwd=cache.parent, stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    said = [one.communicate(timeout=60)[0] for one in running]
    assert all(one.returncode == 0 for one in running)
    assert len(set(said)) == 1
    assert len(files(cache)) == 1


@pytest.mark.parametrize("keep", [True, False])
def test_a_unit_gives_the_commands_of_the_device_time_after_time(tmp_path, keep):
    rng = np.random.default_rng(0)
    unit = FirmwareUnit(CHAIN, "q31", keep)
    trigger = np.zeros(400, bool)
    trigger[0] = True
    device = HostDevice(build("host", GAINS, tmp_path))
    for _ in range(3):
        codes = rng.integers(0, 4096, 400)
        device.reset()
        wanted = positions_of(device.run(codes.astype(np.uint16), trigger), CHAIN.reach)
        np.testing.assert_array_equal(unit(REGULATOR, codes), wanted)


def test_a_unit_follows_the_regulator_it_is_given():
    other = replace(REGULATOR, row=-REGULATOR.row)
    codes = np.full(400, 2100)
    unit = FirmwareUnit(CHAIN, "q31", keep=False)
    # Rounding is by floor of half a step more: mirrored commands are one step off at most.
    step = 2 * CHAIN.reach / 4095
    assert np.abs(unit(REGULATOR, codes) + unit(other, codes)).max() <= step * 1.001
    assert np.ptp(unit(REGULATOR, codes)) > 100 * step
