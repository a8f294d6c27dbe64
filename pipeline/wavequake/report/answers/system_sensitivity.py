"""The sensitivities of an optical system as tables for the terminal."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.store.whole import Arrays
from wavequake.report.answers.sensitivity import conclusion, step_errors, warnings, zernike_name
from wavequake.report.table import MISSING, empty_table, number

Array = NDArray[np.float64]

_NOTHING = 1e-6  # of the largest number of the same unit: what rounding leaves of a zero
_TITLES = {
    "surface": "Surfaces: motion about the vertex, in the surface's own axes",
    "body": "Bodies: motion about the body's point, in the axes of its first surface",
    "deformation": "Figures of surfaces, heights along z",
}


def tables(found: Arrays) -> Iterator[Table]:
    """Yield the tables of surfaces, bodies and figures that a dataset holds."""
    for name in _TITLES:
        if f"sensitivity_los_{name}" in found:
            yield _table(found, name)


def _table(found: Arrays, name: str) -> Table:
    zernike = found[f"sensitivity_zernike_{name}"]
    element, column = map(str, zernike.dims[1:3])
    fields, labels = ([str(one) for one in found[key].values] for key in ("field", column))
    turning = name != "deformation"
    units = (" or rad", "µm or µrad") if turning else ("", "nm")
    words = f"{element}\n{'motion' if turning else 'figure'}", f"largest term\n{fields[-1]}"
    sights, errors = [f"LOS {axis}\n{fields[0]}" for axis in "xy"], [f"WFE\n{field}" for field in fields]
    table = empty_table(
        (words[0], *sights, *errors, words[1]),
        words,
        fixed=True,
        pad_edge=False,
        title=f"{_TITLES[name]}\nLOS in mm per mm{units[0]}; WFE rms, j ≥ 4, in nm per {units[1]}",
    )
    turns = np.array([label.startswith("r") for label in labels])
    los = _zeroed(found[f"sensitivity_los_{name}"].values * np.where(turns, 1.0, 1e-3)[:, None], turns)
    waves = _zeroed(zernike.values[..., 3:] * (1e-6 if turning else 1e-9), turns)
    rms = np.sqrt(np.sum(waves**2, axis=-1))
    for row, label in enumerate(map(str, found[element].values)):
        head = f"[bold]{label}[/]"
        for index, dof in enumerate(labels):
            if not (los[:, row, index].any() or rms[:, row, index].any()):
                continue
            cells = [number(float(value), 4) for value in los[0, row, index]]
            cells += [number(float(value), 4) for value in rms[:, row, index]]
            motion = dof if turning else f"Z{dof}"
            table.add_row(f"{head}  {motion}", *cells, _largest(waves[-1, row, index]))
            head = " " * len(label)
        table.add_section()
    return table


def _largest(values: Array) -> str:
    place = int(np.argmax(np.abs(values)))
    return zernike_name(place + 4) if values[place] else MISSING


def _zeroed(values: Array, turns: NDArray[np.bool_]) -> Array:
    """Zero what is small beside the largest of values (field, element, dof, ...) of the same unit."""
    kept = values.copy()
    for mask in (turns, ~turns):
        part = kept[:, :, mask]
        size = np.abs(part)
        kept[:, :, mask] = np.where(size < _NOTHING * size.max(initial=0.0), 0.0, part)
    return kept


def answer(found: Arrays) -> str:
    """Say which surface, or which body where there are some, matters most at the worst field point."""
    name = "body" if "sensitivity_los_body" in found else "surface"
    scale = np.where([dof < 3 for dof in range(6)], 1e-3, 1.0)[:, None]
    los = np.linalg.norm(found[f"sensitivity_los_{name}"].values * scale, axis=-1).max(axis=0)
    waves = found[f"sensitivity_zernike_{name}"].values[..., 3:] * 1e-6
    rms = np.sqrt(np.sum(waves**2, axis=-1)).max(axis=0)
    element = str(found[f"sensitivity_zernike_{name}"].dims[1])
    return conclusion([str(one) for one in found[element].values], los, rms)


def explanations(found: Arrays) -> list[str]:
    """Return what the numbers mean, how they were made and how far two steps agree, in lines."""
    attrs = found.attrs
    steps, errors = found["step_surface"].values, step_errors(found, _TITLES)
    lines = [
        f"At {attrs['wavelength_nm']:.6g} nm. LOS: {attrs['line_of_sight']}, in the image plane. WFE: rms of "
        "the fitted Zernike terms j ≥ 4. Motions that change neither are left out.",
        f"Central differences, steps {steps[0]:g} m and {steps[3]:.2g} rad. Steps twice as large agree to "
        f"(worst, relative): {errors}.",
    ]
    return [*lines, *warnings(found, "At rest openings stop {}", "system acts nonlinearly")]
