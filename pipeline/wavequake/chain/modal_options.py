"""Options of the modal model of light, which are the same in every optics."""

from typing import Annotated, Any, Literal

from pydantic import Field

Light = Literal["traced", "modal"]
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

_EARLIER = {"standard": "traced"}


def with_light(given: Any) -> Any:
    """Return the keys of a section [optics] with `light` for `method`, as files and stores once called it.

    Of both the later one counts: it overrides what was there.
    """
    if not (isinstance(given, dict) and "method" in given):
        return given
    found: dict[str, Any] = {}
    for key, value in given.items():
        if key == "method":
            found["light"] = _EARLIER.get(value, value) if isinstance(value, str) else value
        else:
            found[key] = value
    return found


def with_method(record: dict[str, Any]) -> dict[str, Any]:
    """Return what identifies a study, with the key of before: its stores stay those of the same study."""
    found = {key: value for key, value in record.items() if key != "light"}
    if "light" in record:
        found["method"] = "standard" if record["light"] == "traced" else record["light"]
    return found
