"""Sensitivities of a telescope or any other system as one labelled dataset, which stores keep."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.campaign.provenance import collect
from wavequake.campaign.schema import Study
from wavequake.campaign.store.store import MANIFEST, SENSITIVITY, read_manifest, refuse_foreign, refuse_other
from wavequake.campaign.store.whole import Arrays, Labelled, read_arrays, write_dataset
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.optics.checks import whole
from wavequake.optics.derivatives.central import DOFS, SensitivityMatrix
from wavequake.optics.polynomials.zernike import MOST_TERMS

SCHEMA = 1
MIRROR_TERMS = 11  # of figures by default: up to primary spherical aberration
LINE_OF_SIGHT = "direction of the best-fit plane (Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))"
_MM_PER_M = 1e3


@dataclass(frozen=True)
class Elements:
    """What moves or deforms, and the derivatives with respect to it.

    Attributes
    ----------
    dim, column : str
        Dimensions of its matrices: what moves, and how ("dof") or the term of its figure.
    label, column_label : str
        What the entries of both are.
    frame : str
        What a derivative is per, such as a motion in certain axes.
    matrices : tuple of SensitivityMatrix
        One, or one for each field point.
    """

    dim: str
    column: str
    label: str
    column_label: str
    frame: str
    matrices: tuple[SensitivityMatrix, ...]


def sensitivity_dataset(
    elements: Mapping[str, Elements],
    fields: Sequence[str],
    wavelength_nm: float,
    obscuration: float,
    device: Device,
    vignetted: str,
    note: str,
) -> Arrays:
    """Label sensitivities and convert them from the optics' mm and waves to m and nm.

    Parameters
    ----------
    elements : mapping
        By the names X of variables below.
    fields : sequence of str
        Names of field points, of which every element has a matrix each; empty: there is one, without a
        dimension.
    wavelength_nm, obscuration : float
        Of waves, and of the annular polynomials.
    device : Device
        On which the matrices were computed.
    vignetted, note : str
        Which light is stopped at rest, and what is assumed of the optics; empty: nothing.

    Returns
    -------
    Arrays
        ``sensitivity_zernike_X`` ([field], element, column, noll) in nm per m or rad, ``sensitivity_los_X``
        and ``sensitivity_centroid_X`` (..., axis) in mm per m or rad, ``sensitivity_wfe_rms_raw_X`` in nm
        per m or rad, ``step_error_X``, and ``step_X`` (column,). A column of dx, dy, dz or of a figure is per
        m, one of rx, ry, rz per rad.
    """
    first = next(iter(elements.values())).matrices[0]
    over = ("field",) if len(fields) else ()
    terms = np.arange(1, first.zernike.shape[2] + 1)
    variables: dict[str, Labelled] = {}
    coordinates: dict[str, Labelled] = {
        **(
            {"field": Labelled(("field",), _text(fields), {"long_name": "field point"})}
            if len(fields)
            else {}
        ),
        "dof": Labelled(("dof",), _text(DOFS), {"long_name": "motion"}),
        "noll": Labelled(("noll",), terms, {"long_name": "Noll index"}),
        "axis": Labelled(("axis",), _text(("x", "y")), {"long_name": "axis of the image plane"}),
    }
    worst = {}
    for name, one in elements.items():
        variables |= _variables(name, over, one, wavelength_nm, obscuration)
        coordinates[one.dim] = Labelled((one.dim,), _text(one.matrices[0].elements), {"long_name": one.label})
        if one.column != "dof":
            numbers = np.arange(1, len(one.matrices[0].dofs) + 1)
            coordinates[one.column] = Labelled((one.column,), numbers, {"long_name": one.column_label})
        element, dof, error = max((each.worst for each in one.matrices), key=lambda item: item[2])
        worst[f"worst_step_error_{name}"] = f"{error:.1e} ({element} {dof})"
    attrs = {
        "title": "Wavequake kinematic-optical sensitivities (Störkle 2018, Eq. 4.21)",
        "schema": SCHEMA,
        "line_of_sight": LINE_OF_SIGHT,
        "wavelength_nm": wavelength_nm,
        "method": "central differences of full traces about the optics at rest",
        "step_tolerance": first.tolerance,
        "steps_agree": int(all(each.agrees for one in elements.values() for each in one.matrices)),
        **worst,
        **({"vignetted": vignetted} if vignetted else {}),
        **({"note": note} if note else {}),
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return Arrays(variables | coordinates, attrs)


def _variables(
    name: str, over: tuple[str, ...], one: Elements, wavelength_nm: float, obscuration: float
) -> dict[str, Labelled]:
    """Return the arrays of an element's matrices by name, in nm or mm per m or rad."""
    dofs, dims = one.matrices[0].dofs, (*over, one.dim, one.column)
    scale = np.array([1.0 if dof in DOFS[3:] else _MM_PER_M for dof in dofs])
    unit = "m or rad" if one.column == "dof" else "m"

    def joined(key: str) -> Any:
        parts = [getattr(each, key) for each in one.matrices]
        return np.stack(parts) if over else parts[0]

    def derived(key: str, factor: float, length: str, what: str, *more: str) -> Labelled:
        values = joined(key) * scale.reshape(-1, *(1 for _ in more)) * factor
        return Labelled(
            (*dims, *more),
            values,
            {"units": f"{length} per {unit}", "long_name": f"{what}, per {one.frame}"},
        )

    zernike = derived("zernike", wavelength_nm, "nm", "annular Noll Zernike coefficients", "noll")
    marked = {**zernike.attrs, "obscuration": repr(obscuration)}
    sight = f"line of sight in the image: {LINE_OF_SIGHT}"
    centroid = "geometric centroid of the rays in the image"
    raw = "rms over the rays that arrive of the wavefront's change, piston removed"
    error = (
        "difference to the result of the double step over the largest sensitivity to any motion of the same "
        "unit; inf if the motion loses rays"
    )
    width = {"units": unit, "long_name": "half width of the central differences"}
    return {
        f"sensitivity_zernike_{name}": zernike._replace(attrs=marked),
        f"sensitivity_los_{name}": derived("los", 1.0, "mm", sight, "axis"),
        f"sensitivity_centroid_{name}": derived("centroid", 1.0, "mm", centroid, "axis"),
        f"sensitivity_wfe_rms_raw_{name}": derived("rms_raw", wavelength_nm, "nm", raw),
        f"step_error_{name}": Labelled(dims, joined("disagreement"), {"units": "1", "long_name": error}),
        f"step_{name}": Labelled((one.column,), one.matrices[0].steps / scale, width),
    }


def _text(names: Sequence[str]) -> Any:
    return np.array(names, dtype=object)


def require_terms(*numbers: int) -> None:
    """Raise UserError unless the numbers of Zernike terms can be."""
    for number in numbers:
        if not 0 <= whole(number, "the number of figure terms") <= MOST_TERMS:
            raise UserError(f"There cannot be {number} figure terms; choose from 0 to {MOST_TERMS}.")


def require_own_store(study: Study, path: Path) -> None:
    """Raise UserError if the store at `path` is that of another study, or no store."""
    refuse_foreign(path)
    if (path / MANIFEST).exists():
        manifest = read_manifest(path)
        refuse_other(path, manifest, study.study.workflow, study.identity_text(), manifest.device_kind)


def kept_or_made(
    study: Study, path: Path, terms: Mapping[str, int], make: Callable[[], Arrays]
) -> tuple[Arrays, bool]:
    """Return the sensitivities that a store keeps if they have these `terms`, or those that are made now.

    Raises
    ------
    UserError
        If it keeps those of another study, or cannot be written.
    StoreDamageError
        If what is there cannot be read.
    """
    text, target = study.identity_text(), path / SENSITIVITY
    if target.exists():
        kept = open_sensitivity(path)
        if kept.attrs["study"] != text:
            name = json.loads(kept.attrs["study"])["study"]["name"]
            raise UserError(
                f"{target} belongs to another study ({name}-{kept.attrs['study_sha256'][:8]}, this one is "
                f"{study.study.name}-{study.identity()[:8]}); choose another --store."
            )
        if all(kept.attrs.get(key) == value for key, value in terms.items()):
            return kept, True
    made = make()
    attrs = {**made.attrs, "study": text, "study_sha256": study.identity(), **terms}
    write_dataset(replace(made, attrs=attrs), target)
    return open_sensitivity(path), False


def open_sensitivity(path: Path | str) -> Arrays:
    """Read the sensitivities that a store keeps; raises as `read_arrays`, also if it keeps none."""
    target = Path(path) / SENSITIVITY
    absent = f"There are no sensitivities at {target}; wavequake sensitivity STUDY computes them."
    return read_arrays(target, SCHEMA, absent)
