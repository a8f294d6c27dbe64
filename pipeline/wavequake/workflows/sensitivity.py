"""The sensitivities of a study's telescope as a labelled dataset, computed once and kept with its store."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from wavequake.campaign.provenance import collect
from wavequake.campaign.schema import Study
from wavequake.campaign.store.store import (
    MANIFEST,
    SENSITIVITY,
    read_manifest,
    refuse_foreign,
    refuse_other,
)
from wavequake.campaign.store.whole import Labelled, read_dataset, write_dataset
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.optics.checks import whole
from wavequake.optics.derivatives.central import DOFS, SensitivityMatrix
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.segments.prepared import prepare
from wavequake.optics.segments.sensitivity import Sensitivities, sensitivities
from wavequake.workflows.segments.bench import MM_PER_M, Bench, bench_of
from wavequake.workflows.segments.segment_study import SegmentStudy, segment_text
from wavequake.workflows.sensitivity_source import sensitivity_study
from wavequake.workflows.study import study_with

if TYPE_CHECKING:
    import xarray as xr

SCHEMA = 1
MIRROR_TERMS = 11  # of figures by default: up to primary spherical aberration
LINE_OF_SIGHT = "direction of the best-fit plane (Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))"


def sensitivity(
    study: str | Path | Study,
    *,
    store: str | Path | None = None,
    figure_terms: int | None = None,
    mirror_terms: int | None = None,
    **overrides: Any,
) -> "xr.Dataset":
    """Return the kinematic-optical sensitivities of a study's telescope or optical system.

    Parameters
    ----------
    study : str, Path or Study
        Name of a bundled study, path of a study file, or a loaded study; name of a bundled system or
        telescope, or a lens file (``lens.zmx``), with defaults for all else.
    store : str or Path, optional
        Folder of the store, which keeps them as ``sensitivity.zarr``; by default that of the study's runs.
    figure_terms : int, optional
        Circular Noll Zernike terms of the figure of each segment; by default those of the study.
    mirror_terms : int, optional
        The same of each mirror after M1 (Störkle 2018, Eq. 4.26), over the axial beam's footprint; of each
        surface that reflects or refracts of any other optical system. By default 11, 0 leaves them out.
    **overrides
        Further keys with double underscores for dots, e.g. ``optics__wavelength_nm=1000.0``.

    Returns
    -------
    xarray.Dataset
        ``sensitivity_zernike_surface`` and so on, see `dataset`.

    Raises
    ------
    UserError
        For a study, a key or a store that cannot be used.

    Examples
    --------
    >>> found = sensitivity("double-gauss", optics__rays=100)  # doctest: +SKIP
    >>> found.sensitivity_los_surface.dims  # doctest: +SKIP
    """
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    loaded = study_with(study, keys) if isinstance(study, Study) else sensitivity_study(study, keys)
    path = loaded.folder(store)
    return stored_sensitivity(loaded, path, figure_terms, mirror_terms)[0]


def stored_sensitivity(
    study: Study, path: Path, figure_terms: int | None = None, mirror_terms: int | None = None
) -> tuple["xr.Dataset", bool]:
    """Return the sensitivities that the store at `path` keeps, and whether they were there already.

    What is not there is computed and written: first beside, then renamed, so that there is never half of it.

    Raises
    ------
    UserError
        If the store belongs to another study or cannot be written, or there are too many figure terms.
    StoreDamageError
        If what is there cannot be read.
    """
    if study.study.workflow in ("system-disturbance", "system-loop"):
        # Another kind of studies; and the first of these builds on this module.
        from wavequake.workflows.systems.system_sensitivity import stored_system_sensitivity
        from wavequake.workflows.systems.system_study import SystemStudy

        assert isinstance(study, SystemStudy)
        study = study.disturbed
        return stored_system_sensitivity(study, path, figure_terms, mirror_terms)
    text = _telescope_text(study)
    require_own_store(study, path)
    device = choose_device(study.campaign.device)
    bench = bench_of(text)
    terms = bench.figure_terms if figure_terms is None else figure_terms
    has_mirrors = len(bench.system.surfaces) > 1
    if mirror_terms is None:
        mirror_terms = MIRROR_TERMS if has_mirrors else 0
    require_terms(terms, mirror_terms)
    if mirror_terms and not has_mirrors:
        raise UserError(f"The telescope {bench.system.name} has no mirror after M1 that could have a figure.")
    return kept_or_made(
        study,
        path,
        {"figure_terms": terms, "mirror_terms": mirror_terms, "surfaces": len(bench.system.surfaces) + 1},
        lambda: dataset(bench, _of_bench(bench, device, terms, mirror_terms), device),
    )


def _telescope_text(study: Study) -> str:
    """Return the identity text of the segment-disturbance study whose telescope a study looks through."""
    if study.study.workflow == "segment-mor":
        from wavequake.workflows.segments.segment_mor_study import SegmentMorStudy, telescope_study

        assert isinstance(study, SegmentMorStudy)
        return telescope_study(study).identity_text()
    if isinstance(study, SegmentStudy):
        study.require_one_place("Sensitivities are")
        return segment_text(study.identity_text())
    raise UserError(
        f"The workflow {study.study.workflow} of {study.study.name} has no sensitivities; "
        "segment-disturbance, segment-mor, telescope-exposure, telescope-loop, system-disturbance and "
        "system-loop have."
    )


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
    study: Study, path: Path, terms: Mapping[str, int], make: Callable[[], "xr.Dataset"]
) -> tuple["xr.Dataset", bool]:
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
    made.attrs |= dict(terms)
    write_dataset(made, target)
    return open_sensitivity(path), False


def _of_bench(bench: Bench, device: Device, figure_terms: int, mirror_terms: int) -> Sensitivities:
    prepared = replace(
        bench.prepared, slopes=None, sphere=None
    )  # always those of the OPD about the chief ray
    with threadpool_limits(1):  # their number decides the last bits
        if figure_terms != bench.figure_terms or mirror_terms:
            terms = bench.study.wavefront.zernike_terms
            prepared = prepare(
                bench.system, prepared.rays, prepared.wavelength, terms, figure_terms, mirror_terms
            )
        return sensitivities(prepared, device, field=bench.field)


def dataset(bench: Bench, found: Sensitivities, device: Device) -> "xr.Dataset":
    """Label sensitivities and convert them from the optics' mm and waves to m and nm.

    Returns
    -------
    xarray.Dataset
        For ``X`` in ``surface`` (dims surface, dof), ``segment`` (segment, dof) and, with figure terms,
        ``figure`` (segment, term) and ``mirror`` (mirror, mirror_term):
        ``sensitivity_zernike_X`` (..., noll) in nm per m or rad,
        ``sensitivity_los_X`` and ``sensitivity_centroid_X`` (..., axis) in mm per m or rad,
        ``sensitivity_wfe_rms_raw_X`` in nm per m or rad, ``step_error_X``. A column of dx, dy, dz or of a
        figure is per m, one of rx, ry, rz per rad.
    """
    import xarray as xr

    surfaces = found.all_surfaces
    matrices = {"surface": ("surface", surfaces), "segment": ("segment", found.segments)}
    if found.figures is not None:
        matrices["figure"] = ("segment", found.figures)
    if found.mirrors is not None:
        matrices["mirror"] = ("mirror", found.mirrors)
    variables: dict[str, Labelled] = {}
    for name, (element, matrix) in matrices.items():
        variables |= _variables(name, element, matrix, bench.study.optics.wavelength_nm)
        variables[f"sensitivity_zernike_{name}"][2]["obscuration"] = repr(bench.prepared.obscuration)
    coordinates: dict[str, Labelled] = {
        "surface": (("surface",), _text(surfaces.elements), {"long_name": "surface; M1 is all its segments"}),
        "segment": (("segment",), _text(found.segments.elements), {"long_name": "segment of M1"}),
        "dof": (("dof",), _text(DOFS), {"long_name": "motion"}),
        "noll": (("noll",), np.arange(1, surfaces.zernike.shape[2] + 1), {"long_name": "Noll index"}),
        "axis": (("axis",), _text(("x", "y")), {"long_name": "axis of the image plane"}),
    }
    if found.figures is not None:
        coordinates["term"] = (
            ("term",),
            np.arange(1, len(found.figures.dofs) + 1),
            {"long_name": "Noll index of the figure over the segment's circumscribed circle"},
        )
    if found.mirrors is not None:
        coordinates["mirror"] = (("mirror",), _text(found.mirrors.elements), {"long_name": "mirror after M1"})
        coordinates["mirror_term"] = (
            ("mirror_term",),
            np.arange(1, len(found.mirrors.dofs) + 1),
            {"long_name": "Noll index of the figure over the axial beam's footprint"},
        )
    worst = {name: matrix.worst for name, (_, matrix) in matrices.items()}
    attrs = {
        "title": "Wavequake kinematic-optical sensitivities (Störkle 2018, Eq. 4.21)",
        "schema": SCHEMA,
        "study": bench.text,
        "study_sha256": bench.study.identity(),
        "line_of_sight": LINE_OF_SIGHT,
        "method": "central differences of full traces about the reference configuration",
        "step_tolerance": surfaces.tolerance,
        "steps_agree": int(all(matrix.agrees for _, matrix in matrices.values())),
        **{
            f"worst_step_error_{name}": f"{error:.1e} ({element} {dof})"
            for name, (element, dof, error) in worst.items()
        },
        **({"vignetted": words} if (words := bench.stopped.words()) else {}),
        **({"note": bench.system.note} if bench.system.note else {}),
        "device": f"{device.name} ({device.kind})",
        **collect(device),
    }
    return xr.Dataset(variables, coordinates, attrs)


def _variables(
    name: str, element: str, matrix: SensitivityMatrix, wavelength_nm: float
) -> dict[str, Labelled]:
    """Return the arrays of one matrix by name, in nm or mm per m or rad."""
    column = {"figure": "term", "mirror": "mirror_term"}.get(name, "dof")
    frame = {
        "surface": "motion about the vertex in the axes of the optics frame (z along the incoming light)",
        "segment": "motion about the center in the segment's local frame (dz to the sky)",
        "figure": "surface height to the sky",
        "mirror": "surface height along the surface's z axis (for M2 along the incoming light)",
    }[name]
    per_mm = np.array([dof not in DOFS[3:] for dof in matrix.dofs])
    scale = np.where(per_mm, MM_PER_M, 1.0)
    unit = "m or rad" if column == "dof" else "m"
    dims = (element, column)

    def named(long_name: str, units: str) -> dict[str, str]:
        return {"units": units, "long_name": f"{long_name}, per {frame}"}

    return {
        f"sensitivity_zernike_{name}": (
            (*dims, "noll"),
            matrix.zernike * scale[:, None] * wavelength_nm,
            named("annular Noll Zernike coefficients", f"nm per {unit}"),
        ),
        f"sensitivity_los_{name}": (
            (*dims, "axis"),
            matrix.los * scale[:, None],
            named(f"line of sight in the image plane: {LINE_OF_SIGHT}", f"mm per {unit}"),
        ),
        f"sensitivity_centroid_{name}": (
            (*dims, "axis"),
            matrix.centroid * scale[:, None],
            named("geometric centroid of the rays in the image plane", f"mm per {unit}"),
        ),
        f"sensitivity_wfe_rms_raw_{name}": (
            dims,
            matrix.rms_raw * scale * wavelength_nm,
            named("rms over the rays on glass of the wavefront's change, piston removed", f"nm per {unit}"),
        ),
        f"step_error_{name}": (
            dims,
            matrix.disagreement,
            {
                "units": "1",
                "long_name": "difference to the result of the double step over the largest sensitivity "
                "to any motion of the same unit; inf if the motion loses rays",
            },
        ),
        f"step_{name}": (
            (column,),
            matrix.steps / scale,
            {"units": unit, "long_name": "half width of the central differences"},
        ),
    }


def _text(names: tuple[str, ...]) -> Any:
    return np.array(names, dtype=object)


def open_sensitivity(path: Path | str) -> "xr.Dataset":
    """Read the sensitivities that a store keeps.

    Raises
    ------
    UserError
        If it keeps none, or those of another version of Wavequake.
    StoreDamageError
        If they cannot be read.
    """
    target = Path(path) / SENSITIVITY
    if not target.exists():
        raise UserError(f"There are no sensitivities at {target}; wavequake sensitivity STUDY computes them.")
    return read_dataset(target, SCHEMA)
