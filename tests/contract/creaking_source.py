"""A source that the package does not have, as somebody else would add it: this file is all there is."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from wavequake.mechanics.disturbances.motion import still
from wavequake.mechanics.disturbances.source import Names, Source, register


@register
class Creaking(Source):
    """Elements that slip once along their axis, each at a random instant by a random step."""

    independent: ClassVar = "element"

    model: Literal["creaking"] = "creaking"
    of: Names = Field(description="names or patterns of what creaks")
    step_nm: float = Field(gt=0, description="rms of the steps")

    def draw(self, layout, time, randoms):
        """Draw an instant and a step for each element."""
        moved = {}
        for name in self.elements(layout):
            random = randoms(f"{self.name}/{name}")
            when, step = random.random(1)[0], random.standard_normal(1)[0]
            moved[name] = np.zeros((len(time), 6))
            moved[name][time >= when * self.duration_s, 2] = step * self.step_nm * 1e-9
        return still(len(time), len(layout), rigid=moved)
