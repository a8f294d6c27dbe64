"""Amplitudes of a study file that are too large to be meant: most likely a unit is mistaken."""

from collections.abc import Iterator, Mapping
from typing import Any

from wavequake.campaign.schema import Study

# Largest amplitude of a vibration or misalignment that nobody asks about: a centimeter, a tenth of a radian.
_M, _RAD = (1e-2, "m"), (0.1, "rad")
_UNITS = {
    "nm": (1e-9, _M),
    "um": (1e-6, _M),
    "nrad": (1e-9, _RAD),
    "urad": (1e-6, _RAD),
    "mas": (4.84813681109536e-9, _RAD),
}


def doubts(study: Study) -> Iterator[str]:
    """Yield a sentence for every amplitude of a disturbance whose unit is likely to be mistaken."""
    for entry in study.model_dump().get("disturbance", ()):
        yield from _of(entry, f"disturbance.{entry['name']}", "")


def _of(value: Any, where: str, unit: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _of(part, f"{where}.{key}", str(key).rpartition("_")[2] if "_" in str(key) else unit)
    elif isinstance(value, list | tuple):
        for place, part in enumerate(value):
            yield from _of(part, f"{where}.{place}", unit)
    elif isinstance(value, float) and unit in _UNITS:
        factor, (largest, base) = _UNITS[unit]
        if abs(value) * factor > largest:
            yield f"warning: {where} = {value:g} is {value * factor:.3g} {base}; is {unit} its unit?"
