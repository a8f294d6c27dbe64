"""The arrays that every store has: how each case ended, and why."""

from collections.abc import Mapping
from typing import cast

from wavequake.campaign.contract import STATUS_MEANINGS, Variable

_STATUS = {
    "long_name": "how the case ended; its numbers are valid where this is 1",
    "flag_values": list(range(6)),
    "flag_meanings": STATUS_MEANINGS,
}
MESSAGE = "message"
"""A chunk without failed cases has no file of it."""
ENGINE_VARIABLES = {
    MESSAGE: Variable((), (), {"long_name": "why the case has no valid numbers"}, dtype="str"),
    "status": Variable((), (), cast(Mapping[str, str], _STATUS), dtype="int8"),
}
