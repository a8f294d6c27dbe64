"""The first picture of a report: the system, mirror or segments that the study is about."""

import json

import xarray as xr
from matplotlib.figure import Figure

from wavequake.campaign.schema import study_from_identity
from wavequake.drawing.draw import draw, look
from wavequake.errors import UserError
from wavequake.workflows.kinds import find_kind


def drawn_layout(dataset: xr.Dataset) -> tuple[str, Figure, str] | None:
    """Return title, figure and caption of what a study is about; None if it cannot be drawn."""
    text = str(dataset.attrs.get("study", ""))
    try:
        model = find_kind(json.loads(text)["study"]["workflow"]).model
        study = study_from_identity(model, text)
        seen, figure = look(study), draw(study)
    except (ValueError, KeyError, TypeError, UserError):  # a part of a store, or one of another program
        return None
    if seen.models:
        title = "What the study is about: the finite-element mirror, from above and from the side"
        how = "Blue is the optical surface, gray dots are all nodes, triangles the mounts by number."
    elif seen.telescope is not None:
        title = "What the study is about: the segments from above, and the section of the telescope, to scale"
        how = "Dashed circles are the pupil, thin lines rays."
    else:
        title = "What the study is about: the optical layout, to scale"
        how = "Lines are rays, each field in a color and line style of its own; two ticks are the stop."
    return title, figure, how
