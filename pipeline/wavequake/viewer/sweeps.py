"""A sweep: the same cases of its study at several points."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from wavequake.campaign.contract import DONE
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest
from wavequake.errors import UserError
from wavequake.viewer.film import Stage, Take
from wavequake.workflows.sweep import SweepStudy, point_study, points_of

Tell = Callable[[str], None]
Maker = Callable[[xr.Dataset, Manifest, Sequence[int], Tell], tuple[tuple[Stage, ...], tuple[Take, ...]]]

_MOST_POINTS = 4


def film_of(
    dataset: xr.Dataset, manifest: Manifest, chosen: Sequence[int], tell: Tell, maker: Maker
) -> tuple[tuple[Stage, ...], tuple[Take, ...]]:
    """Return the chosen cases, or of some points the cases that tell most at the first of them.

    Raises
    ------
    UserError
        If no case is done, or as the maker of the study that is swept.
    """
    study = study_from_identity(SweepStudy, manifest.study)
    points, each = points_of(study), study.each
    wanted: dict[int, list[int]] = {}
    for case in chosen:
        wanted.setdefault(case // each, []).append(case % each)
    if not chosen:
        done = dataset["status"].to_numpy().reshape(len(points), each) == DONE
        some = np.flatnonzero(done.any(axis=1))
        if not len(some):
            raise UserError("No case of the store is done yet; there is nothing to view.")
        kept = some[np.unique(np.linspace(0, len(some) - 1, _MOST_POINTS).round().astype(int))]
        wanted = {int(point): [] for point in kept}
    stages, takes, same = list[Stage](), list[Take](), list[int]()
    for point, cases in wanted.items():
        text = point_study(study.base, points[point]).identity_text()
        here = dataset.isel(case=slice(point * each, (point + 1) * each))
        here = here.assign_coords(case=np.arange(each)).assign_attrs(study=text)
        one = replace(manifest, workflow=study.base["study"]["workflow"], study=text, cases=each)
        words = ", ".join(f"{key} = {value}" for key, value in points[point].items())
        # Beside the cases that tell most at the first point the same ones are shown, to be compared.
        there, found = maker(here, one, cases or same, lambda line, words=words: tell(f"{words}: {line}"))  # type: ignore[misc]
        same = same or list(dict.fromkeys(take.case for take in found))
        takes += [
            replace(
                take,
                label=f"{words}: {take.label} (case {point * each + take.case} of the sweep)",
                stage=take.stage + len(stages),
                case=point * each + take.case,
            )
            for take in found
        ]
        stages += there
    return tuple(stages), tuple(takes)
