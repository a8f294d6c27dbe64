"""Lens files in archives: what is in them is read, what is damaged is told in one sentence."""

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.optics.lens_archive import lens_of_archive

sys.path.insert(0, str(Path(__file__).parents[1] / "fuzz"))
import zar_file

LENSES = Path(__file__).parents[1] / "data" / "lenses"
LENS = (LENSES / "pyzdde_doublet.zmx").read_bytes()


@pytest.mark.parametrize("recent", [True, False], ids=["EC03", "EA03"])
@pytest.mark.parametrize("lens", sorted(LENSES.glob("optiland*.zmx")), ids=lambda path: path.stem)
def test_the_lens_comes_out_as_it_was_packed(lens, recent):
    data = lens.read_bytes()
    assert lens_of_archive(zar_file.archive(data, recent), "a.zar") == data
    assert lens_of_archive(zar_file.entry("PLAIN.ZMX", data, recent), "a.zar") == data


def test_codes_become_longer_with_the_table():
    """Some 20,000 codes: 9 to 15 bits, and words that repeat themselves."""
    numbers = np.random.default_rng(3).integers(0, 256, 30_000).astype(np.uint8).tobytes()
    data = numbers + 5000 * b"abab" + numbers[:999]
    assert lens_of_archive(zar_file.entry("A.ZMX.LZW", data), "a.zar") == data


def test_a_known_archive_of_a_few_bytes():
    """The word "abababab" by hand: a, b, ab (256), aba (258), b: codes of 9 bits."""
    body = int("".join(format(code, "09b") for code in (97, 98, 256, 258, 98)) + "000", 2).to_bytes(6, "big")
    assert zar_file.packed(b"abababab") == body
    assert lens_of_archive(zar_file.entry("A.ZMX.LZW", b"abababab"), "a.zar") == b"abababab"


def test_archives_are_loaded_as_lens_files_are(tmp_path, wavequake):
    path = tmp_path / "lens.ZAR"
    path.write_bytes(zar_file.archive(LENS))
    plain = wq.load_system(LENSES / "pyzdde_doublet.zmx")
    assert wq.info(wq.load_system(path)).splitlines()[1:] == wq.info(plain).splitlines()[1:]
    code, out, err = wavequake("info", path)
    assert code == 0, err
    assert "focal length" in out
    (tmp_path / "study.toml").write_text(
        '[study]\nname = "a"\nworkflow = "system-disturbance"\n[system]\nfile = "lens.ZAR"\n[[disturbance]]\n'
        'name = "b"\nmodel = "surface-random"\nof = ["surface 1"]\nrms = { dz_um = 1.0 }\n'
    )
    assert len(wq.load_system(tmp_path / "study.toml").surfaces) == len(plain.surfaces)


WHOLE = zar_file.archive(LENS)
BROKEN = {
    "no lens": (zar_file.entry("A.AGF", b"CC"), r"needs one lens file \(.zmx\) in it; it has none"),
    "two lenses": (2 * zar_file.entry("A.ZMX", LENS), "it has A.ZMX, A.ZMX"),
    "cut short": (WHOLE[:-700], r"the archive .* is (cut short|damaged)"),
    "cut in a header": (WHOLE + b"\xec\x03" + bytes(20), "is damaged at byte"),
    "rubbish behind": (WHOLE + b"rubbish", "is damaged at byte"),
    "another code": (
        zar_file.entry("A.ZMX", b"").replace(b".\0Z\0M\0X\0", b".\0Z\0M\0X\0.\0L\0Z\0W\0")[:0x288][:16]
        + (2).to_bytes(8, "little") + (100).to_bytes(8, "little") + bytes(16)
        + "A.ZMX.LZW".encode("utf-16-le").ljust(0x288 - 0x30, b"\0") + b"\xff\xff",
        "a code that means nothing",
    ),
    "longer than it says": (zar_file.entry("A.ZMX.LZW", LENS, size=10), "is longer than it announces"),
    "10 GB": (zar_file.entry("A.ZMX.LZW", LENS, size=10**10), "announces a lens file of 10000000000 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_damaged_archives_are_told_in_a_sentence(name, tmp_path):
    data, message = BROKEN[name]
    path = tmp_path / "a.zar"
    path.write_bytes(data)
    with pytest.raises(UserError, match=f"(?i){message}"):
        wq.load_system(path)


def test_what_expands_without_bound_takes_no_memory():
    """A megabyte of codes of the same letter would be 10 GB: it ends where the header says, or at 100 MB."""
    codes = [97, *range(256, 60_000)]  # a, aa, aaa, ...: each the one that only it makes known
    text = "".join(
        format(code, f"0{max(9, (254 + k).bit_length())}b") for k, code in enumerate(codes, start=1)
    )
    body = int(text + "0" * (-len(text) % 8), 2).to_bytes(-(-len(text) // 8), "big")
    head = zar_file.entry("A.ZMX.LZW", b"", size=1_000_000)[:0x288]
    data = head[:16] + len(body).to_bytes(8, "little") + head[24:] + body
    tracemalloc.start()
    with pytest.raises(UserError, match="is longer than it announces"):
        lens_of_archive(data, "a.zar")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6
