"""Exposures in the report of a system-disturbance store: at rest and over the vibration, field by field."""

from collections.abc import Iterator

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.report.exposures.camera import camera_pictures
from wavequake.report.exposures.figures import Panel, exposure_panels
from wavequake.report.exposures.psf_figures import image_row
from wavequake.report.page import Picture, picture
from wavequake.report.table import number
from wavequake.workflows.systems.bench import SystemBench, field_name

_FIELDS = 4  # whose exposures a report shows; the store has all


def pictures(
    name: str, cases: NDArray[np.int64], bench: SystemBench, dataset: xr.Dataset
) -> Iterator[Picture]:
    """Yield the exposures of a disturbance: of the case with the median peak, at rest beside it."""
    if "exposure" not in dataset or "exposure_static" not in dataset or not len(cases):
        return
    peaks = dataset["peak"].sel(case=cases).min("field").to_numpy()
    case = int(cases[np.argsort(peaks)[len(peaks) // 2]])
    one, rest = dataset.sel(case=case), dataset["exposure_static"].to_numpy()
    exposures, axis = one["exposure"].to_numpy(), dataset["x"].to_numpy()
    panels = []
    for field in range(min(len(rest), _FIELDS)):
        where = field_name(bench.system, field)
        panels.append(
            Panel(f"{where}, at rest: peak {number(float(rest[field].max()))}", rest[field], _still())
        )
        words = f"case {case}: peak {number(float(exposures[field].max()))}"
        panels.append(Panel(words, exposures[field], _track(one, bench, field)))
    yield picture(
        f"{name}-exposures",
        f"Exposures, {name}: at rest, and of the case with the median peak; red: its line of sight",
        exposure_panels(panels, axis),
        "Four decades of irradiance; a long red track blurs the image more than any aberration.",
    )
    names = [field_name(bench.system, field) for field in range(len(rest))]
    yield from camera_pictures(name, case, one, names)
    if "object_image" in dataset and "object_static" in dataset:
        seen = np.concatenate(
            [dataset["object_static"].to_numpy()[:1], one["object_image"].to_numpy()[:_FIELDS]]
        )
        titles = ["at rest", *(field_name(bench.system, field) for field in range(len(seen) - 1))]
        yield picture(
            f"{name}-object",
            f"The object, {name}: at rest, and exposed at each field",
            image_row(seen, titles, axis),
            "What the detector sees of the object while the system vibrates.",
        )


def _still() -> NDArray[np.float64]:
    return np.empty((0, 2))


def _track(one: xr.Dataset, bench: SystemBench, field: int) -> NDArray[np.float64]:
    """Return the line of sight over time in lambda/D, where the store keeps it."""
    if "time" not in one["los_mm"].dims:
        return _still()
    los = one["los_mm"].isel(field=field, wavelength=bench.system.primary_wavelength).to_numpy()
    return np.asarray(los[np.isfinite(los).all(axis=1)] / float(one["resolution_mm"]))
