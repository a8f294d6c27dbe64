"""What reports of segmented telescopes say of light that mirrors stop."""

from pathlib import Path

import numpy as np
import xarray as xr

from wavequake.campaign.store.store import read_manifest
from wavequake.workflows.segments.bench import bench_of


def stopped_light(store: Path, dataset: xr.Dataset) -> str:
    """Return sentences on rays that are lost at rest or that mirrors stop in cases; nothing if all arrive."""
    stopped = bench_of(read_manifest(store).study).stopped
    parts = [stopped.words()] if stopped.words() else []
    if "vignetted" in dataset:
        counts = dataset["vignetted"].to_numpy()
        more = counts > stopped.vignetted  # False for cases that are not done
        if more.any():
            parts.append(
                f"up to {int(counts[more].max())} of {stopped.rays} are stopped at an instant of "
                f"{np.count_nonzero(more)} of {np.count_nonzero(np.isfinite(counts))} cases"
            )
    if not parts:
        return ""
    words = "; ".join(parts)
    return f"{words[0].upper()}{words[1:]}. All numbers are those of the light that arrives."
