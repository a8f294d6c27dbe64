"""Disturbances of any optical system without segments: sources by surfaces and bodies, and their sums."""

from typing import Annotated

from pydantic import Field

from wavequake.mechanics.disturbances.history_facts import MOST_INSTANTS
from wavequake.mechanics.disturbances.population import Population
from wavequake.mechanics.disturbances.registry import Combine
from wavequake.mechanics.disturbances.source import AnySource


class CombinedElements(Combine):
    """The sum of other disturbances of the study, drawn at this population's own instants.

    With a surface-history among them these are the rows of its file, and `instants` and `duration_s` are left
    out.
    """

    instants: int = Field(
        default=16, ge=1, le=MOST_INSTANTS, description="of the sum, evenly spread over duration_s"
    )


ElementDisturbance = Annotated[Population, AnySource("surfaces", CombinedElements)]
