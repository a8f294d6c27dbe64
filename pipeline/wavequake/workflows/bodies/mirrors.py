"""Built-in mirrors behind the surfaces of a system."""

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import AnnularMirror, CircularMirror
from wavequake.mechanics.model import RayleighDamping
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.system import OpticalSystem
from wavequake.workflows.bodies.sections import MirrorBodySection, SolidSection

MM_PER_M = 1e3
_MOUNTS = 0.645  # of the radius: near where three points hold a thin disc with the least sag


def material_of(section: SolidSection) -> Material:
    """Return what a body is made of."""
    return Material(section.youngs_modulus_pa, section.poisson_ratio, section.density_kg_m3)


def glass_side(system: OpticalSystem, index: int) -> float:
    """Return 1 where the glass of a mirror, away from the light, is at +z of its surface, or -1."""
    here = system.surfaces[index]
    before = [np.asarray(one.position) for one in system.surfaces[:index]]
    paths = [one for point in before if np.linalg.norm(one := here.position - point) > 1e-9]
    light = paths[-1] if paths else np.array([0.0, 0.0, 1.0])
    return 1.0 if float(here.rotation[:, 2] @ light) > 0.0 else -1.0


def mirror_behind(
    name: str, section: MirrorBodySection, system: OpticalSystem, index: int, facing: float
) -> CircularMirror | AnnularMirror:
    """Return the built-in mirror of a surface; `facing`: sign of its model's z axis in the surface's."""
    surface = system.surfaces[index]
    form = surface.deformation
    assert isinstance(form, ZernikeDeformation)
    diameter = section.diameter_m or 2.0 * form.pupil_radius / MM_PER_M
    if diameter < 2.0 * form.pupil_radius / MM_PER_M * (1.0 - 1e-6):
        raise UserError(
            f"The mirror {name!r} has a diameter of {diameter:g} m, but light or the opening of "
            f"{surface.name!r} reaches {2.0 * form.pupil_radius / MM_PER_M:g} m; make it larger."
        )
    radius = getattr(surface.shape, "radius", np.inf) / MM_PER_M
    common = {
        "diameter": diameter,
        "thickness": section.thickness_m,
        "focal_length": np.inf if section.shape == "plate" else facing * radius / 2.0,
        "material": material_of(section),
        "mount_radius": section.mount_radius_m or _MOUNTS * diameter / 2.0,
        "mount_angles": tuple(facing * angle for angle in section.mount_angles_deg),
        "damping": RayleighDamping(0.0, 0.0),
        "rings": section.rings,
    }
    if section.shape == "annulus":
        around = 6 * -(-8 * section.rings // 6)
        return AnnularMirror(inner_diameter=section.inner_diameter_m, around=around, **common)  # type: ignore[arg-type]
    return CircularMirror(core=section.rings, **common)  # type: ignore[arg-type]
