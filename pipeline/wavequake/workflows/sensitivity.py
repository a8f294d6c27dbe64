"""The sensitivities of a study's telescope as a labelled dataset, computed once and kept with its store."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.schema import Study
from wavequake.campaign.store.whole import Arrays
from wavequake.chain.sensitivities import (
    MIRROR_TERMS,
    Elements,
    kept_or_made,
    require_own_store,
    require_terms,
    sensitivity_dataset,
)
from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device, choose_device
from wavequake.optics.segments.prepared import at_field, prepare
from wavequake.optics.segments.sensitivity import Sensitivities, sensitivities
from wavequake.prepared import one_thread
from wavequake.workflows.segments.bench import Bench, bench_of
from wavequake.workflows.segments.study import SegmentStudy, segment_text
from wavequake.workflows.sensitivity_source import sensitivity_study
from wavequake.workflows.study import study_with

if TYPE_CHECKING:
    import xarray as xr


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
        ``sensitivity_zernike_surface`` and so on, see `wavequake.chain.sensitivities.sensitivity_dataset`.

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
    return stored_sensitivity(loaded, path, figure_terms, mirror_terms)[0].dataset()


def stored_sensitivity(
    study: Study, path: Path, figure_terms: int | None = None, mirror_terms: int | None = None
) -> tuple[Arrays, bool]:
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
        from wavequake.workflows.systems.sensitivity import stored_system_sensitivity
        from wavequake.workflows.systems.study import SystemStudy

        assert isinstance(study, SystemStudy)
        return stored_system_sensitivity(study, path, figure_terms, mirror_terms)
    text = _telescope_text(study)
    require_own_store(study, path)
    device = choose_device(study.campaign.device)
    bench = bench_of(text)
    terms = bench.figure_terms if figure_terms is None else figure_terms
    has_mirrors = len(bench.system.after_primary) > 1
    if mirror_terms is None:
        mirror_terms = MIRROR_TERMS if has_mirrors else 0
    require_terms(terms, mirror_terms)
    if mirror_terms and not has_mirrors:
        raise UserError(f"The telescope {bench.system.name} has no mirror after M1 that could have a figure.")
    return kept_or_made(
        study,
        path,
        {
            "figure_terms": terms,
            "mirror_terms": mirror_terms,
            "surfaces": len(bench.system.after_primary) + 1,
        },
        lambda: _dataset(bench, _of_bench(bench, device, terms, mirror_terms), device),
    )


def _telescope_text(study: Study) -> str:
    """Return the identity text of the segment-disturbance study whose telescope a study looks through."""
    if study.study.workflow == "segment-mor":
        from wavequake.workflows.segments.mor_study import SegmentMorStudy, telescope_study

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


@one_thread()
def _of_bench(bench: Bench, device: Device, figure_terms: int, mirror_terms: int) -> Sensitivities:
    prepared = replace(
        bench.prepared, slopes=None, sphere=None
    )  # always those of the OPD about the chief ray
    if figure_terms != bench.figure_terms or mirror_terms:
        terms = bench.study.wavefront.zernike_terms
        prepared = prepare(
            bench.system, prepared.rays, prepared.wavelength, terms, figure_terms, mirror_terms
        )
    return sensitivities(at_field(prepared, bench.field), device)


def _dataset(bench: Bench, found: Sensitivities, device: Device) -> Arrays:
    """Label the matrices of M1's segments, of M1 as a whole and of what comes after it."""
    elements = {
        "surface": Elements(
            *("surface", "dof", "surface; M1 is all its segments", "motion"),
            "motion about the vertex in the surface's own frame at rest",
            (found.all_surfaces,),
        ),
        "segment": Elements(
            *("segment", "dof", "segment of M1", "motion"),
            "motion about the center in the segment's local frame (dz to the sky)",
            (found.segments,),
        ),
    }
    if found.figures is not None:
        elements["figure"] = Elements(
            *("segment", "term", "segment of M1"),
            "Noll index of the figure over the segment's circumscribed circle",
            "surface height to the sky",
            (found.figures,),
        )
    if found.mirrors is not None:
        elements["mirror"] = Elements(
            *("mirror", "mirror_term", "mirror after M1"),
            "Noll index of the figure over the axial beam's footprint",
            "surface height along the surface's z axis (for M2 along the incoming light)",
            (found.mirrors,),
        )
    return sensitivity_dataset(
        elements,
        (),
        bench.study.optics.wavelength_nm,
        bench.prepared.system.pupil.obscuration,
        device,
        bench.stopped.words(),
        bench.system.note,
    )
