"""Parts of one's own that lack a method are refused where they are registered, by its name."""

from dataclasses import dataclass
from typing import Literal

import pytest

from wavequake.chain.loops.block import Actuator, Controller, Sensor, register
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.source import SOURCES, Source
from wavequake.optics.shapes import shape as shapes


@pytest.mark.parametrize(
    ("base", "add", "missing"),
    [
        (Controller, register, "no design of"),
        (Sensor, register, "no labels and no matrix of"),
        (Actuator, register, "no channels and no put of"),
        (Source, SOURCES.add, "no draw of"),
    ],
)
def test_a_part_without_its_methods(base, add, missing):
    class Half(base):
        """Half written."""

        model: Literal["half"] = "half"

    with pytest.raises(UserError, match=missing):
        add(Half)
    assert "half" not in SOURCES.known()


def test_a_shape_of_lens_files_that_reads_none():
    @dataclass(frozen=True)
    class Half(shapes.Shape):
        """Half written."""

        zemax = "HALF"

    with pytest.raises(UserError, match="the shape Half has no from_zemax and no zemax_lines of its own"):
        shapes.register(Half)
    assert "Half" not in shapes.SHAPES.known()
