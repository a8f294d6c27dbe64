"""What reports call the models of a store."""

import json

import numpy as np
import xarray as xr

_LABELS = ("model", "checked_model")


def name_models(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose imported model is called by its file, where that is known."""
    study = json.loads(dataset.attrs["study"])
    section = study.get("base", study).get("model")  # of a sweep, or of any study
    content = section.get("content") if isinstance(section, dict) else None
    if content is None:
        return dataset
    from wavequake.workflows.mirrors.model_store import shown_name  # slow to load

    named = {
        label: (
            dataset[label].dims,
            np.array([shown_name(content, str(one)) for one in dataset[label].to_numpy()], dtype=object),
            dataset[label].attrs,
        )
        for label in _LABELS
        if label in dataset.coords
    }
    return dataset.assign_coords(named)
