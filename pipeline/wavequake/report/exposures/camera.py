"""What a camera makes of a case, for every report with exposures: counts, through focus, widths."""

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr

from wavequake.report.exposures.psf_figures import image_row
from wavequake.report.page import Picture, picture
from wavequake.report.table import number

_MOST = 5  # images side by side


CAMERA = frozenset({"counts", "exposure_focus", "fwhm"})
"""Variables of which there are pictures."""


def camera_pictures(name: str, case: int, one: xr.Dataset, field_names: Sequence[str]) -> Iterator[Picture]:
    """Yield the pictures of a case `one` of a store whose exposures have fields, or one without a name."""
    one = one if "field" in one.dims else one.expand_dims("field")
    if "counts" in one:
        counts = one["counts"].transpose("field", "detector_y", "detector_x").to_numpy()[:_MOST]
        ratios = one["snr"].to_numpy()
        titles = [
            "\n".join(filter(None, (where, f"signal to noise {number(float(ratio))}")))
            for where, ratio in zip(field_names, ratios, strict=False)
        ]
        yield picture(
            f"{name}-counts",
            f"Electrons that the detector reads, {name}, case {case}",
            image_row(counts, titles[: len(counts)], one["detector_x"].to_numpy(), "µm", "electrons"),
            "With the noise of photons and of reading; signal to noise is that of the brightest pixel.",
        )
    if "exposure_focus" in one:
        planes = one["focus"].to_numpy()
        chosen = np.unique(np.linspace(0, len(planes) - 1, min(len(planes), _MOST)).round().astype(int))
        images = one["exposure_focus"].transpose("field", "focus", "y", "x").to_numpy()[0][chosen]
        titles = [
            f"{number(float(planes[index]))} µm: {number(float(image.max()))}"
            for index, image in zip(chosen, images, strict=True)
        ]
        where = f", {field_names[0]}" if field_names[0] else ""
        yield picture(
            f"{name}-focus",
            f"Exposures through focus, {name}, case {case}{where}",
            image_row(images, titles, one["x"].to_numpy()),
            "How far each plane is behind the image along the light, and the peak of its exposure."
            + _widths(one, field_names),
        )
    elif "fwhm" in one:
        yield picture(
            f"{name}-widths",
            f"How sharp the exposure is, {name}, case {case}",
            image_row(
                one["exposure"].transpose("field", "y", "x").to_numpy()[:_MOST],
                [*field_names][:_MOST],
                one["x"].to_numpy(),
            ),
            _widths(one, field_names).lstrip(),
        )


def _widths(one: xr.Dataset, field_names: Sequence[str]) -> str:
    """Say how wide the exposures of each field are."""
    if "fwhm" not in one:
        return ""
    words = []
    for field, where in zip(range(one.sizes["field"]), field_names, strict=False):
        wide, apart = (one[name].isel(field=field).to_numpy() for name in ("fwhm", "two_point"))
        words.append(
            f"{where}{': ' * bool(where)}half of the maximum is {number(float(wide[0]))} by "
            f"{number(float(wide[1]))} λ/D wide, two points are told apart (Rayleigh) at "
            f"{number(float(apart[0]))} along x and {number(float(apart[1]))} along y"
        )
    return " " + "; ".join(words) + "."
