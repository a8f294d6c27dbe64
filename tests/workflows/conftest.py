"""What the tests of workflows share."""

import pytest
from small_histories import small_study

from wavequake.workflows.mirrors import model_store
from wavequake.workflows.run import run_study
from wavequake.workflows.study import study_with


@pytest.fixture(scope="module")
def mirror_models(tmp_path_factory):
    """Keep built mirrors out of the user's cache; all modules of a process share one folder."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.getbasetemp() / "mirror-models"
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield


@pytest.fixture(scope="session")
def kept_stores(tmp_path_factory):
    """Return the small study of a workflow, and its store under some keys of `store`, as functions."""
    folder, made = tmp_path_factory.mktemp("kept"), set()

    def study_of(name):
        return small_study(name, folder)

    def store_of(name, **keys):
        place = folder / "-".join([name, *map(str, keys.values())])
        if place not in made:
            chosen = {f"store.{key}": value for key, value in keys.items()}
            run_study(study_with(study_of(name), chosen), place, on="serial")
            made.add(place)
        return place

    return study_of, store_of
