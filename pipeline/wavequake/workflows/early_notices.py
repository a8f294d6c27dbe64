"""What can be said of a study before anything of it is prepared."""

from collections.abc import Iterator

from wavequake.campaign.schema import Study
from wavequake.chain.doubts import doubts
from wavequake.workflows.out_of_focus import out_of_focus
from wavequake.workflows.without_cases import without_cases


def early_notices(study: Study) -> Iterator[str]:
    """Yield sentences on doubtful units, disturbances without a case, and optics that are out of focus."""
    yield from doubts(study)
    yield from without_cases(study)
    yield from out_of_focus(study)
