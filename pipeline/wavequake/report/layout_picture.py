"""The first picture of a report: the system, mirror or segments that the study is about."""

import json
from collections.abc import Iterator

import xarray as xr

from wavequake.campaign.schema import study_from_identity
from wavequake.drawing.draw import draw
from wavequake.errors import UserError
from wavequake.report.page import Picture, picture
from wavequake.workflows.kinds import find_kind


def layout_picture(dataset: xr.Dataset) -> Iterator[Picture]:
    """Draw what the study of a store is about; nothing where that is not known or cannot be drawn."""
    text = str(dataset.attrs.get("study", ""))
    try:
        model = find_kind(json.loads(text)["study"]["workflow"]).model
        figure = draw(study_from_identity(model, text))
    except (ValueError, KeyError, TypeError, UserError):  # a part of a store, or one of another program
        return
    yield picture(
        "layout",
        "What the study is about: the optical layout or the mirror, to scale",
        figure,
        "Dashed lines are clear apertures or the pupil, thin lines rays.",
    )
