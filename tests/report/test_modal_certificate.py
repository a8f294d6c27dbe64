"""What a report says of the modal model's error."""

import numpy as np
import pytest
import xarray as xr

from wavequake.campaign.contract import DONE
from wavequake.report.certificate import certificate
from wavequake.workflows.segments.modal import CERTIFIED, MODAL, TRACED

LIMIT = "beyond its range (second order above 0.1 nm)"


@pytest.mark.parametrize(
    ("routes", "words"),
    [
        ([], []),
        ([TRACED], [f"every case is {LIMIT}; all numbers are those of full traces."]),
        ([TRACED, TRACED], [f"every case is {LIMIT}; all numbers are those of full traces."]),
        ([CERTIFIED], [f"1 case, all of which were traced in full to measure its error; none is {LIMIT}."]),
        (
            [CERTIFIED, MODAL, TRACED],
            [
                "2 cases, of which 1 were traced in full to measure its error; the numbers of 1 more, "
                f"{LIMIT}, are those of full traces."
            ],
        ),
    ],
)
def test_the_modal_model_is_said_to_have_the_cases_that_it_has(routes, words):
    routes = np.array([*routes, MODAL], dtype=np.int8)
    status = np.full(len(routes), DONE)
    status[-1] = 0  # not done: no word of it
    said = certificate(0.1, xr.Dataset({"traced": ("case", routes), "status": ("case", status)}))
    assert said == [f"Modal model: {one}" for one in words]
