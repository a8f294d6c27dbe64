"""The sensitivities of a system-disturbance study as a labelled dataset: every surface, body and field."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.provenance import collect
from wavequake.campaign.store.whole import Labelled
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.optics.derivatives.central import DOFS, SensitivityMatrix
from wavequake.optics.derivatives.sensitivity import figure_sensitivity, rigid_sensitivity
from wavequake.workflows.sensitivity import (
    LINE_OF_SIGHT,
    MIRROR_TERMS,
    SCHEMA,
    kept_or_made,
    require_own_store,
    require_terms,
)
from wavequake.workflows.systems.system_bench import (
    MM_PER_M,
    NM_PER_MM,
    SystemBench,
    deformable,
    field_name,
    prepared_fields,
    system_bench,
)
from wavequake.workflows.systems.system_study import SystemStudy

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]

_FRAMES = {
    "surface": "motion of a surface about its vertex in its own frame",
    "body": "motion of a body about its point in the frame of its first surface",
    "deformation": "height of a surface along its z axis",
}


def stored_system_sensitivity(
    study: SystemStudy, path: Path, figure_terms: int | None = None, terms: int | None = None
) -> tuple["xr.Dataset", bool]:
    """Return the sensitivities that the store at `path` keeps, and whether they were there already.

    Raises
    ------
    UserError
        If terms of segments' figures are asked for, or as `wavequake.workflows.sensitivity` says.
    """
    if figure_terms:
        raise UserError("The system has no segments with figures; --mirror-terms are those of its surfaces.")
    if terms is None:
        terms = MIRROR_TERMS
    require_terms(terms)
    require_own_store(study, path)
    device = choose_device(study.campaign.device)
    return kept_or_made(study, path, {"mirror_terms": terms}, lambda: system_dataset(study, device, terms))


def system_dataset(study: SystemStudy, device: Device, terms: int = 0) -> "xr.Dataset":
    """Return the sensitivities at the primary wavelength and all fields, in m and nm.

    Returns
    -------
    xarray.Dataset
        For ``X`` in ``surface``, ``body`` (dims field, X, dof) and, with `terms`, ``deformation`` (field,
        deformed, term): ``sensitivity_zernike_X`` (..., noll) in nm per m or rad, ``sensitivity_los_X`` and
        ``sensitivity_centroid_X`` (..., axis) in mm per m or rad, ``sensitivity_wfe_rms_raw_X`` in nm per m
        or rad, ``step_error_X``.
    """
    import xarray as xr

    bench = system_bench(study.identity_text())
    primary = [bench.system.primary_wavelength]
    count = len(bench.system.surfaces)
    matrices: dict[str, tuple[str, str, list[SensitivityMatrix]]] = {}
    with threadpool_limits(1):  # their number decides the last bits
        rows = [row[0] for row in prepared_fields(study, bench.system, primary)]
        rigid = [rigid_sensitivity(one, bench.bodies, device) for one in rows]
        matrices["surface"] = ("surface", "dof", [_part(one, slice(0, count)) for one in rigid])
        if bench.bodies:
            matrices["body"] = ("body", "dof", [_part(one, slice(count, None)) for one in rigid])
        if terms:
            acting = [i for i, surface in enumerate(bench.system.surfaces) if surface.action != "pass"]
            system = deformable(bench.system, dict.fromkeys(acting, terms))
            figures = [
                figure_sensitivity(row[0], acting, terms, device)
                for row in prepared_fields(study, system, primary)
            ]
            matrices["deformation"] = ("deformed", "term", figures)
    wavelength_nm = float(bench.system.wavelengths[primary[0]]) * NM_PER_MM
    variables: dict[str, Labelled] = {}
    coordinates: dict[str, Labelled] = {
        "field": (
            ("field",),
            _text([field_name(bench.system, index) for index in range(len(rows))]),
            {"long_name": "field point"},
        ),
        "dof": (("dof",), _text(DOFS), {"long_name": "motion"}),
        "noll": (("noll",), np.arange(1, study.wavefront.zernike_terms + 1), {"long_name": "Noll index"}),
        "axis": (("axis",), _text(("x", "y")), {"long_name": "axis of the image plane"}),
    }
    worst = {}
    for name, (element, column, found) in matrices.items():
        variables |= _variables(name, (element, column), found, wavelength_nm)
        variables[f"sensitivity_zernike_{name}"][2]["obscuration"] = repr(bench.system.pupil.obscuration)
        coordinates[element] = ((element,), _text(found[0].elements), {"long_name": element})
        largest = max((one.worst for one in found), key=lambda item: item[2])
        worst[f"worst_step_error_{name}"] = f"{largest[2]:.1e} ({largest[0]} {largest[1]})"
    if terms:
        coordinates["term"] = (("term",), np.arange(1, terms + 1), {"long_name": "Noll index of the figure"})
    attrs = {
        "title": "Wavequake kinematic-optical sensitivities (Störkle 2018, Eq. 4.21)",
        "schema": SCHEMA,
        "study": study.identity_text(),
        "study_sha256": study.identity(),
        "line_of_sight": LINE_OF_SIGHT,
        "wavelength_nm": wavelength_nm,
        "method": "central differences of full traces about the system at rest",
        "step_tolerance": rigid[0].tolerance,
        "steps_agree": int(all(one.agrees for _, _, found in matrices.values() for one in found)),
        **worst,
        **_vignetted(bench),
        **({"note": bench.system.note} if bench.system.note else {}),
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return xr.Dataset(variables, coordinates, attrs)


def _vignetted(bench: SystemBench) -> dict[str, str]:
    """Return how many rays openings stop at rest, field by field, if they stop any."""
    counts = [int(row[bench.system.primary_wavelength].vignetted[0]) for row in bench.static]
    stopped = [
        f"{count} of {bench.study.optics.rays} rays of {field_name(bench.system, field)}"
        for field, count in enumerate(counts)
        if count
    ]
    return {"vignetted": "; ".join(stopped)} if stopped else {}


def _part(matrix: SensitivityMatrix, part: slice) -> SensitivityMatrix:
    """Return the matrix of some of its elements."""
    return SensitivityMatrix(
        elements=matrix.elements[part],
        dofs=matrix.dofs,
        steps=matrix.steps,
        zernike=matrix.zernike[part],
        los=matrix.los[part],
        centroid=matrix.centroid[part],
        rms_raw=matrix.rms_raw[part],
        disagreement=matrix.disagreement[part],
        tolerance=matrix.tolerance,
    )


def _variables(
    name: str, dims: tuple[str, str], found: Sequence[SensitivityMatrix], wavelength_nm: float
) -> dict[str, Labelled]:
    """Return the arrays of one matrix over the fields by name, in nm or mm per m or rad."""
    scale = np.array([1.0 if dof in DOFS[3:] else MM_PER_M for dof in found[0].dofs])
    unit = "m" if name == "deformation" else "m or rad"
    over = ("field", *dims)

    def stored(key: str, factor: float, units: str, what: str, *more: str) -> Labelled:
        values = np.stack([getattr(one, key) for one in found]) * factor
        shaped = scale.reshape(-1, *(1 for _ in more))
        return (*over, *more), values * shaped, {"units": units, "long_name": f"{what}, per {_FRAMES[name]}"}

    return {
        f"sensitivity_zernike_{name}": stored(
            "zernike", wavelength_nm, f"nm per {unit}", "Noll Zernike coefficients", "noll"
        ),
        f"sensitivity_los_{name}": stored("los", 1.0, f"mm per {unit}", LINE_OF_SIGHT, "axis"),
        f"sensitivity_centroid_{name}": stored(
            "centroid", 1.0, f"mm per {unit}", "geometric centroid of the rays in the image", "axis"
        ),
        f"sensitivity_wfe_rms_raw_{name}": stored(
            "rms_raw",
            wavelength_nm,
            f"nm per {unit}",
            "rms over the rays of the wavefront's change, no piston",
        ),
        f"step_error_{name}": (
            over,
            np.stack([one.disagreement for one in found]),
            {
                "units": "1",
                "long_name": "difference to the result of the double step over the largest sensitivity "
                "to any motion of the same unit; inf if the motion loses rays",
            },
        ),
        f"step_{name}": (
            (dims[1],),
            found[0].steps / scale,
            {"units": unit, "long_name": "half width of the central differences"},
        ),
    }


def _text(names: Sequence[str]) -> Any:
    return np.array(names, dtype=object)
