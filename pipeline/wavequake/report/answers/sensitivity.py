"""Sensitivities for the terminal: a table of the surfaces, one of the segments, and what the numbers mean."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.store.whole import Arrays
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.polynomials.zernike import noll_to_nm
from wavequake.report.table import MISSING, empty_table, number

Array = NDArray[np.float64]

_PER_MILLIMETER = np.array([1e-3] * 3 + [1.0] * 3)  # mm per m -> mm per mm; mm per rad
_FAMILIES = ("spherical", "coma", "astigmatism", "trefoil", "tetrafoil", "pentafoil")
_TERMS = 3
_NOTHING = 1e-6  # of the largest number of the same unit: what rounding leaves of a zero
_NO_LOS, _NO_WFE = 1e-5, 1e-6  # mm per rad and nm per µrad that nobody can see, whatever is the largest


def zernike_name(j: int) -> str:
    """Return the usual name of a Noll term, such as ``coma y``; x is the cosine, y the sine."""
    n, m = noll_to_nm(j)
    if (n, m) in ((0, 0), (2, 0)):
        return "piston" if n == 0 else "defocus"
    if n == 1:
        return "tilt x" if m > 0 else "tilt y"
    frequency = abs(m)
    first = {0: 4, 1: 3}.get(frequency, frequency)  # the degree of the family's first term
    order = (n - first) // 2 + 1
    family = _FAMILIES[frequency] if frequency < len(_FAMILIES) else f"{frequency}-foil"
    axis = "" if m == 0 else " x" if m > 0 else " y"
    ordinal = {1: "", 2: "2nd ", 3: "3rd "}.get(order, f"{order}th ")
    return f"{ordinal}{family}{axis}"


def tables(found: Arrays) -> Iterator[Table]:
    """Yield the tables of surfaces, segments and figures of mirrors that a dataset holds."""
    yield surface_table(found)
    yield segment_table(found)
    if "sensitivity_los_mirror" in found:
        yield mirror_table(found)


def surface_table(found: Arrays) -> Table:
    """Return the table of M1 as a whole and the surfaces after it: line of sight, largest Zernike terms."""
    los = _rigid_zeroed(found["sensitivity_los_surface"].values * _PER_MILLIMETER[:, None], _NO_LOS)
    zernike = _rigid_zeroed(found["sensitivity_zernike_surface"].values[..., 3:] * 1e-6, _NO_WFE)
    return _table_by_element(
        "Surfaces: motion about the vertex, along and about the surface's own axes",
        ("surface\nmotion", "mm per mm or rad", "nm per µm or µrad"),
        (found["surface"].values, DOFS),
        (los, zernike),
    )


def mirror_table(found: Arrays) -> Table:
    """Return the table of the figures of the mirrors after M1, one row per term."""
    return _table_by_element(
        "Figures of mirrors over the axial beam's footprint, heights along z of the surface",
        ("mirror\nfigure", "mm per mm", "nm per nm"),
        (found["mirror"].values, [f"Z{j}" for j in found["mirror_term"].values]),
        (
            _zeroed(found["sensitivity_los_mirror"].values * 1e-3),
            _zeroed(found["sensitivity_zernike_mirror"].values[..., 3:] * 1e-9),
        ),
    )


def _table_by_element(
    title: str,
    words: tuple[str, str, str],
    rows: tuple[Sequence[str], Sequence[str]],
    values: tuple[Array, Array],
) -> Table:
    """Return line of sight (element, motion, 2) and terms j >= 4 of every motion of elements.

    `words` are the header of both and the units of the others.
    """
    largest = f"largest Zernike terms from j = 4 on\n{words[2]}"
    headers = (words[0], *(f"LOS {axis}\n{words[1]}" for axis in "xy"), largest)
    table = empty_table(headers, (words[0], largest), fixed=True, pad_edge=False, title=title)
    for name, los, zernike in zip(rows[0], *values, strict=True):
        for place, motion in enumerate(rows[1]):
            label = f"{' ' * len(str(name))}  {motion}" if place else f"[bold]{name}[/]  {motion}"
            terms = ", ".join(_term(j, value) for j, value in _largest(zernike[place]))
            cells = [number(value, 5) for value in los[place]]
            table.add_row(label, *cells, terms or MISSING, end_section=place == len(rows[1]) - 1)
    return table


def _rigid_zeroed(values: Array, per_rad: float) -> Array:
    """Zero what is nothing in values (element, dof, ...) of three shifts and three turns."""
    return np.concatenate([_zeroed(values[:, :3]), _zeroed(values[:, 3:], per_rad)], axis=1)


def _zeroed(values: Array, floor: float = 0.0) -> Array:
    """Replace by zeros what is small beside the largest value, or smaller than `floor`."""
    size = np.abs(values)
    return np.where(size < max(_NOTHING * np.max(size, initial=0.0), floor), 0.0, values)


def _largest(values: Array) -> list[tuple[int, float]]:
    """Return Noll index and value of the largest terms (j >= 4) that are not small beside the first."""
    order = np.argsort(-np.abs(values), kind="stable")[:_TERMS]
    first = np.max(np.abs(values), initial=0.0)
    return [(int(i) + 4, float(values[i])) for i in order if first > 0.0 and abs(values[i]) > 0.01 * first]


def _term(j: int, value: float) -> str:
    return f"{zernike_name(j)} (c{j}) {number(value)}"


def segment_table(found: Arrays) -> Table:
    """Return the table of M1's segments, one row per motion; zeros are below 1e-6 of the largest."""
    count = len(found["segment"].values)
    what = "one piece" if count == 1 else f"{count} segments (min / median / max)"
    waves = [f"WFE rms{of}\nnm per nm or nrad" for of in (", j ≥ 4", " on glass")]
    table = empty_table(
        ("motion", "LOS\nmm per mm or rad", *waves),
        fixed=True,
        pad_edge=False,
        title=f"M1, {what}: motion about the center, dz to the sky",
    )
    los = np.hypot(*np.moveaxis(found["sensitivity_los_segment"].values * _PER_MILLIMETER[:, None], -1, 0))
    fitted = np.sqrt(np.sum(found["sensitivity_zernike_segment"].values[..., 3:] ** 2, axis=-1)) * 1e-9
    raw = found["sensitivity_wfe_rms_raw_segment"].values * 1e-9
    columns = [_rigid_zeroed(los, _NO_LOS), *(_rigid_zeroed(rms, 1e-3 * _NO_WFE) for rms in (fitted, raw))]
    for dof, motion in enumerate(DOFS):
        table.add_row(motion, *(_spread(values[:, dof]) for values in columns))
    if "sensitivity_los_figure" in found:
        los = np.hypot(*np.moveaxis(found["sensitivity_los_figure"].values, -1, 0)) * 1e-3
        fitted = np.sqrt(np.sum(found["sensitivity_zernike_figure"].values[..., 3:] ** 2, axis=-1)) * 1e-9
        raw = found["sensitivity_wfe_rms_raw_figure"].values * 1e-9
        columns = [_zeroed(values) for values in (los, fitted, raw)]
        for index, j in enumerate(found["term"].values):
            table.add_row(f"figure Z{j}", *(_spread(values[:, index]) for values in columns))
    return table


def _spread(values: Array) -> str:
    if len(values) == 1:
        return number(values[0])
    return " / ".join(number(value) for value in np.quantile(values, [0.0, 0.5, 1.0]))


def conclusion(names: Sequence[str], los: Array, rms: Array) -> str:
    """Say which element moves the image most when it shifts and when it turns, and which the wavefront.

    Parameters
    ----------
    names : sequence of str, length E
    los : ndarray, shape (E, 6)
        Image motion, mm per mm and mm per rad.
    rms : ndarray, shape (E, 6)
        Wavefront error, nm per um and nm per urad.
    """
    words = []
    for values, what, units in (
        (los, "moves the image", ("µm per µm", "µm per µrad")),
        (rms, "disturbs the wavefront", ("nm per µm", "nm per µrad")),
    ):
        shares = (values, values * (1e-3 if what == "moves the image" else 1.0))
        parts = []
        for first, verb, numbers, unit in zip((0, 3), ("shifts", "turns"), shares, units, strict=True):
            part = np.nan_to_num(numbers[:, first : first + 3])
            element, dof = divmod(int(np.argmax(part)), 3)
            if part[element, dof] > 0.0:
                value = number(float(part[element, dof]))
                parts.append(f"{names[element]} where it {verb} ({DOFS[first + dof]}: {value} {unit})")
        if parts:
            words.append(f"What {what} most is {' and '.join(parts)}.")
    return " ".join(words)


def answer(found: Arrays) -> str:
    """Say which surface matters most."""
    los = np.linalg.norm(found["sensitivity_los_surface"].values * _PER_MILLIMETER[:, None], axis=-1)
    rms = np.sqrt(np.sum((found["sensitivity_zernike_surface"].values[..., 3:] * 1e-6) ** 2, axis=-1))
    return conclusion([str(one) for one in found["surface"].values], los, rms)


def explanations(found: Arrays) -> list[str]:
    """Return what the numbers mean, how they were made and how far two steps agree, in lines."""
    attrs = found.attrs
    steps = dict(zip(DOFS, found["step_surface"].values, strict=True))
    errors = step_errors(found, ("surface", "segment", "figure", "mirror"), "s")
    figure = f", {found['step_figure'].values[0]:g} m of figure" if "step_figure" in found else ""
    lines = [
        "M1 among the surfaces: all its segments as one rigid body, about its vertex.",
        f"LOS: {attrs['line_of_sight']}, in the image plane; it is neither the chief ray nor the centroid.",
        "WFE rms on glass: over the rays, piston removed; j ≥ 4: of the fitted Zernike terms.",
        f"Central differences, steps {steps['dx']:g} m and {steps['rx']:g} rad{figure}. Steps twice as large "
        f"agree to (worst, relative): {errors}.",
    ]
    return [*lines, *warnings(found, "{}", "telescope acts nonlinearly; another sampling may help")]


def warnings(found: Arrays, lost: str, acts: str) -> Iterator[str]:
    """Yield what to know of the numbers: light that is lost (in these words), steps that disagree, a note."""
    attrs = found.attrs
    if "vignetted" in attrs:
        yield f"{lost.format(attrs['vignetted'])}; the numbers are those of the others."
    if not attrs["steps_agree"]:
        yield (
            f"Not to be trusted: the columns whose step_error is above {attrs['step_tolerance']:g}. A ray "
            f"crosses an edge there or the {acts}."
        )
    if "note" in attrs:
        yield attrs["note"]


def step_errors(found: Arrays, kinds: Iterable[str], many: str = "") -> str:
    """Return how far two steps agree at worst, for each kind of element that there is."""
    key = "worst_step_error_"
    return "; ".join(f"{kind}{many} {found.attrs[key + kind]}" for kind in kinds if key + kind in found.attrs)
