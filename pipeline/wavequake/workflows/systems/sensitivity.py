"""The sensitivities of a system-disturbance study as a labelled dataset: every surface, body and field."""

from pathlib import Path

from threadpoolctl import threadpool_limits

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
from wavequake.optics.derivatives.sensitivity import figure_sensitivity, rigid_sensitivity
from wavequake.workflows.systems.bench import (
    NM_PER_MM,
    SystemBench,
    deformable,
    field_name,
    prepared_fields,
    system_bench,
)
from wavequake.workflows.systems.study import SystemStudy

_FRAMES = {
    "surface": "motion of a surface about its vertex in its own frame",
    "body": "motion of a body about its point in the frame of its first surface",
    "deformation": "height of a surface along its z axis",
}


def stored_system_sensitivity(
    study: SystemStudy, path: Path, figure_terms: int | None = None, terms: int | None = None
) -> tuple[Arrays, bool]:
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
    return kept_or_made(
        study, path, {"mirror_terms": terms}, lambda: system_dataset(study.disturbed, device, terms)
    )


def system_dataset(study: SystemStudy, device: Device, terms: int = 0) -> Arrays:
    """Return the sensitivities at the primary wavelength and all fields, in m and nm.

    For ``surface``, ``body`` and, with `terms`, ``deformation``; see
    `wavequake.chain.sensitivities.sensitivity_dataset`.
    """
    bench = system_bench(study.identity_text())
    system, primary = bench.system, [bench.system.primary_wavelength]
    with threadpool_limits(1):  # their number decides the last bits
        rows = [row[0] for row in prepared_fields(study, system, primary)]
        rigid = [rigid_sensitivity(one, bench.bodies, device) for one in rows]
        parts = {"surface": slice(0, len(system.surfaces))}
        if bench.bodies:
            parts["body"] = slice(len(system.surfaces), None)
        elements = {
            name: Elements(name, "dof", name, "motion", _FRAMES[name], tuple(one.part(part) for one in rigid))
            for name, part in parts.items()
        }
        if terms:
            acting = [i for i, surface in enumerate(system.surfaces) if surface.action != "pass"]
            deforming = prepared_fields(study, deformable(system, dict.fromkeys(acting, terms)), primary)
            figures = tuple(figure_sensitivity(row[0], acting, terms, device) for row in deforming)
            words = "Noll index of the figure", _FRAMES["deformation"]
            elements["deformation"] = Elements("deformed", "term", "deformed", *words, figures)
    return sensitivity_dataset(
        elements,
        [field_name(system, index) for index in range(len(rows))],
        float(system.wavelengths[primary[0]]) * NM_PER_MM,
        system.pupil.obscuration,
        device,
        _vignetted(bench),
        system.note,
    )


def _vignetted(bench: SystemBench) -> str:
    """Return how many rays openings stop at rest, field by field, if they stop any."""
    counts = [int(row[bench.system.primary_wavelength].vignetted[0]) for row in bench.static]
    stopped = [
        f"{count} of {bench.study.optics.rays} rays of {field_name(bench.system, field)}"
        for field, count in enumerate(counts)
        if count
    ]
    return "; ".join(stopped)
