"""The lens bench over frequency: what its controllers leave of blows, and loops through the image."""

from collections.abc import Iterator, Sequence

import xarray as xr

from wavequake.report.loops.over_frequency import (
    by_controller,
    curves_of,
    loops_over_frequency,
    noise_picture,
    spectra_of,
)
from wavequake.report.loops.spectra import of_histories, spectra
from wavequake.report.page import Picture, picture
from wavequake.words import counted
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.loops import OPEN, looked
from wavequake.workflows.loops.curves import frequencies, kept

_MOST, _UM = 64, 1e3  # cases of which spectra are taken; per mm


def over_frequency(dataset: xr.Dataset, springs: str, rows: Sequence[int]) -> Iterator[Picture]:
    """Draw the image motion of some plants by frequency, and the linear loops of a study itself."""
    some = dataset["image"].isel(case=rows[:_MOST]).transpose("controller", "case", "time")
    time = dataset["time"].to_numpy()
    step = float(time[1] - time[0])
    left = [
        of_histories(str(name), step, _UM * values.astype(float)[:, :, None], name == "uncontrolled")
        for name, values in zip(some["controller"].to_numpy(), some.to_numpy(), strict=True)
    ]
    yield picture(
        f"{springs}-spectrum",
        f"Spectrum of the image motion, and how its rms adds up, {springs} springs",
        spectra([one for one in left if one.above[0] > 0], "What is left of the image motion", "µm"),
        f"Of the histories of {counted(some.sizes['case'], 'plant')}, from the blow on, each about its mean; "
        "the thick line is the uncontrolled one. Below is the rms of all that is faster than a frequency. "
        f"{OPEN} So they have no Bode or Nyquist curves and no margins: how far a curve is below the thick "
        "line is all that there is of them over frequency.",
    )
    study = study_of(dataset.attrs["study"])
    found = looked(study, springs)
    if not found:
        return
    hertz = frequencies(study.sensor, [one.loop.timing.period for one in found.values()])
    names = list(found)
    loops = xr.Dataset(kept(names, hertz, found, "um"), {"controller": names, "frequency": hertz})
    rows = by_controller(loops, names)
    yield from loops_over_frequency(f"{springs}-", curves_of(rows))
    if heard := spectra_of(rows, "noise_los"):
        yield noise_picture(f"{springs}-noise", "image", "µm", heard)
