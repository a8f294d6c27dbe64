"""What `wavequake.run` takes: numbers of NumPy, folders that are none, and titles."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError

SMALL = {
    "telescope__name": "tmt-18",
    "optics__rays_per_segment": 6,
    "imaging__pixels": 16,
    "wavefront__zernike_terms": 6,
    "store__chunk_cases": 2,
    "campaign__device": "numpy",
}


def test_counts_may_be_numpys_and_stores_keep_the_title(tmp_path):
    titled = {**SMALL, "study__title": "18 segments <in the wind>"}
    store = tmp_path / "store"
    found = wq.run("tmt-segments", cases=np.int64(2), store=store, **titled)
    assert found.sizes["case"] == 2
    assert found.attrs["study_title"] == "18 segments <in the wind>"
    # The title is no part of the identity: the store goes on under another one.
    again = wq.run("tmt-segments", cases=np.int64(2), store=str(store), **SMALL)
    assert again.attrs["study_sha256"] == found.attrs["study_sha256"]


@pytest.mark.parametrize("store", [3, 2.5, ["runs"], b"runs", True])
def test_a_store_that_is_no_path_is_refused(store):
    with pytest.raises(UserError, match="it must be the path of a folder"):
        wq.run("tmt-segments", cases=2, store=store, **SMALL)
    with pytest.raises(UserError, match="it must be the path of a folder"):
        wq.sensitivity("tmt-segments", store=store, **SMALL)


def test_a_count_that_is_no_whole_number_is_refused():
    with pytest.raises(UserError, match="cases"):
        wq.run("tmt-segments", cases=np.float64(2.5), **SMALL)
