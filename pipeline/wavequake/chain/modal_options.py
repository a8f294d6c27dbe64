"""Options of the modal model of light, which are the same in every optics."""

from typing import Annotated

from pydantic import Field

ModalTolerance = Annotated[
    float,
    Field(
        gt=0,
        description="modal: a case whose OPD may miss this much of second order (rms) is traced in full",
    ),
]
ModalSample = Annotated[
    float,
    Field(
        ge=0,
        le=1,
        description="modal: share of cases that are traced besides, to measure the error; the first 100 "
        "cases always are",
    ),
]
