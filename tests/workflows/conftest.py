"""What the tests of workflows share."""

import pytest

from wavequake.workflows import model_store


@pytest.fixture(scope="module")
def mirror_models(tmp_path_factory):
    """Keep built mirrors out of the user's cache; all modules of a process share one folder."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.getbasetemp() / "mirror-models"
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield
