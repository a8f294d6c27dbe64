"""The table of why rays are lost is one, on the host and in the kernels."""

import re
from pathlib import Path

import numpy as np

from wavequake.kernels.trace import status

HEADER = Path(__file__).parents[2] / "kernels" / "status.h"


def test_the_header_and_the_host_have_the_same_table():
    (inside,) = re.findall(r"enum \{(.*?)\}", HEADER.read_text(), re.S)
    table = {name: int(value) for name, value in re.findall(r"(\w+) = (\d+)", inside)}
    assert table == {name: getattr(status, name) for name in table}
    assert sorted(table.values()) == list(range(7))
    assert not re.findall(r"enum \{", "".join(one.read_text() for one in HEADER.parent.glob("*.cl")))


def test_a_status_says_why_and_where_in_eight_bits():
    codes = [
        status.lost_at(reason, surface)
        for surface in range(-1, status.MOST_SURFACES + 1)
        for reason in range(1, 7)
    ]
    assert len(set(codes)) == len(codes)
    found = status.surface_of(np.array(codes).astype(np.int8))
    assert found.tolist() == np.repeat(np.arange(-1, status.MOST_SURFACES + 1), 6).tolist()
    assert status.surface_of(np.zeros(3, np.int8)).tolist() == [-1, -1, -1]
    assert (np.array(codes) <= np.iinfo(np.int8).max).all()
