"""Damaged files are read, or refused in one sentence, in bounded time and memory: 50 for each reader.

`make fuzz` gives 2000 to each.
"""

import json
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from mutations import damaged
from readers import READERS

from wavequake.errors import UserError
from wavequake.optics.shapes.shape import SHAPES
from wavequake.optics.zemax.codev_tilts import TILTS
from wavequake.optics.zemax.gradients import GRADIENTS
from wavequake.optics.zemax.phases import PHASES
from wavequake.optics.zemax.rows import OF_SURFACES, OPENINGS
from wavequake.optics.zemax.surfaces import MAX_TERMS


@pytest.fixture(scope="module")
def outcome():
    """Return what each reader did, from one process of its own: a reader may crash, or take all memory."""
    script = Path(__file__).with_name("fuzz.py")
    done = subprocess.run(
        [sys.executable, script, "50"], capture_output=True, text=True, timeout=300, check=False
    )
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return {line["reader"]: line for line in lines if "reader" in line}, done.stderr[-2000:]


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_read_or_refused_in_one_sentence(outcome, name):
    by_reader, stderr = outcome
    assert name in by_reader, f"the process died: {stderr}"
    assert by_reader[name]["wrong"] == []
    assert 0 < by_reader[name]["read"] < 50  # the damage leaves some files whole, and breaks others


def test_lenses_that_are_damaged_have_all_that_a_surface_may_have():
    def words(name):
        return {word for make in READERS[name].valid for word in make().decode("latin-1").split()}

    # Other tests add shapes of their own.
    ours = {one.zemax for one in SHAPES.entries().values() if one.__module__.startswith("wavequake.")} - {""}
    types = (*ours, *GRADIENTS, *PHASES, *MAX_TERMS, "EVENASPH", "GRID_SAG", "COORDBRK")
    assert {*types, *OF_SURFACES, *OPENINGS, "SCBD"} - words("zmx") == set()
    assert set(TILTS) - {word.strip(";") for word in words("seq")} == set()


@pytest.mark.parametrize(("number", "said"), [(1540, "has 594 surfaces; at most 126"), (1784, "no stop of")])
def test_sequences_that_2000_damages_found(tmp_path, number, said):
    random = Random(f"seq {number}")
    reader = READERS["seq"]
    file = tmp_path / "damaged.seq"
    file.write_bytes(damaged(random.choice([make() for make in reader.valid]), random))
    with pytest.raises(UserError, match=said):
        reader.read(file)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise ValueError('a')", "ValueError: a at"),
        ("while True: pass", "takes more than"),
        ("raise UserError(601 * 'x')", None),
        ("return bytearray(3 * 10**9)", "MemoryError"),
        ("return bytes(bytearray(600 * 10**6))[:1]", "of memory"),
        ("import os; os.abort()", "died"),
    ],
)
def test_the_harness_finds_what_is_wrong(tmp_path, body, words):
    code = (
        "import fuzz, readers\nfrom wavequake.errors import UserError\nfuzz.TIME_S = LIMIT\nseen = []\n"
        f"def read(path):\n    if not seen: return seen.append(1)\n    {body}\n"
        "readers.READERS['bad'] = readers.Reader('.x', read, readers.text('a'))\nfuzz.main(2, ['bad'])\n"
    )
    code = code.replace("LIMIT", "0.2" if "while" in body else "60")  # s; a busy machine takes its time
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=Path(__file__).parent,
    )
    lines = done.stdout.splitlines()
    if words == "died":
        assert done.returncode < 0
        assert lines == ['{"at": "bad"}']
    elif words is None:
        assert json.loads(lines[-1])["wrong"] == []  # a UserError shortens itself
    else:
        assert done.returncode == 1
        assert any(words in one for one in json.loads(lines[-1])["wrong"])
