"""Study files of Wavequake 0.1: whether they say what they said, and which of their numbers have changed.

No key has moved since 0.1, and none means something else: there is nothing to rewrite. What comes out of some
of them has changed, as the change log says.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavequake.workflows.study import load_study


@dataclass(frozen=True)
class _Change:
    """What comes out otherwise of the studies to which it applies, given as their identity records."""

    key: str
    words: str
    applies: Callable[[dict[str, Any]], bool]


def _cut_by_rounding(record: dict[str, Any]) -> bool:
    reduction = record.get("reduction")
    named = [*reduction.get("variants", ()), str(reduction.get("reference"))] if reduction else []
    return any(one.startswith(("krylov", "rubin", "inertia")) for one in named)


_CHANGES = (
    _Change(
        "reduction.variants",
        "orders of Krylov, Rubin and inertia-relief models that cut a block of moments or a pair of equal "
        "modes give another model, which rounding does not choose: krylov36(150) errs by 2.9 % at 300 Hz, "
        "not 5.6 or 6.2",
        _cut_by_rounding,
    ),
    _Change(
        "imaging",
        "images of segmented telescopes move by up to 1e-6 of the peak, and disturbances are ranked by the "
        "peak of the exposure, which the store now has",
        lambda record: record["study"]["workflow"] == "segment-disturbance" and record["imaging"]["enabled"],
    ),
    _Change(
        "system.file",
        "a numerical aperture in object space (OBNA) is that of real rays, not of paraxial ones",
        lambda record: "OBNA" in str(record.get("system", {}).get("file_text")),
    ),
)


def migrate(study: str | Path) -> list[str]:
    """Return what has changed for a study file of Wavequake 0.1, a sentence for each key; stores nothing.

    Parameters
    ----------
    study : str or Path
        Name of a bundled study or path of a .toml file.

    Raises
    ------
    UserError
        If the file is no study of this version; names the key and the nearest valid one.

    Examples
    --------
    >>> for line in migrate("tmt-exposure"):
    ...     print(line)
    No key of tmt-exposure has moved or means something else than in 0.1: run it as it is, with a new store.
    """
    loaded = load_study(study)
    record = loaded.model_dump(mode="json")
    first = (
        f"No key of {loaded.study.name} has moved or means something else than in 0.1: run it as it is, with "
        "a new store."
    )
    return [first, *(f"{one.key}: {one.words}." for one in _CHANGES if one.applies(record))]
