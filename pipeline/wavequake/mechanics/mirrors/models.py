"""Built-in finite-element models of mirrors: menisci of constant axial thickness; SI units.

The vertex of the front face is the origin and the axis is z. The front face is the parabola z = r^2 / (4 f),
concave toward +z; the rear face is the same, shifted by the thickness. Mounts are nodes of the rear face.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.hexahedra import assemble, lumped_areas
from wavequake.mechanics.mirrors.material import ALUMINUM, GLASS_CERAMIC, Material
from wavequake.mechanics.mirrors.mesh import Mesh, disc_mesh, hexagon_mesh, ring_mesh
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, check_model

DAMPING = RayleighDamping()


@dataclass(frozen=True)
class CircularMirror:
    """A circular mirror; the defaults are those of Störkle 2018, Section 4.3.1.

    Attributes
    ----------
    diameter, thickness, focal_length : float
        m; an infinite focal length makes a flat mirror, a negative one a convex mirror. The reference gives
        no focal length: with 1.7 m the
        defocus mode has 295 Hz.
    material : Material
    mount_radius : float
        m.
    mount_angles : tuple of float
        deg, from the x axis.
    damping : RayleighDamping
    core, rings, layers : int
        Elements along a side of the hexagonal core, around it along a radius, and through the thickness.
    """

    diameter: float = 1.0
    thickness: float = 0.02
    focal_length: float = 1.7
    material: Material = ALUMINUM
    mount_radius: float = 0.333
    mount_angles: tuple[float, ...] = (0.0, 120.0, 240.0)
    damping: RayleighDamping = DAMPING
    core: int = 6
    rings: int = 6
    layers: int = 1


@dataclass(frozen=True)
class AnnularMirror:
    """An annular mirror; attributes as `CircularMirror`, and `around`: elements in one ring."""

    diameter: float = 1.0
    inner_diameter: float = 0.4
    thickness: float = 0.02
    focal_length: float = 1.7
    material: Material = ALUMINUM
    mount_radius: float = 0.333
    mount_angles: tuple[float, ...] = (0.0, 120.0, 240.0)
    damping: RayleighDamping = DAMPING
    around: int = 48
    rings: int = 6
    layers: int = 1


@dataclass(frozen=True)
class HexagonalSegment:
    """A segment of glass ceramic like those of the Thirty Meter Telescope, a corner on the x axis.

    Attributes
    ----------
    side, thickness, parent_radius : float
        m; the parent's vertex radius of curvature, of which a piece around the vertex is taken.
    material : Material
    mount_radius : float
        m; three mounts lie on it, toward every other corner. The default, 0.66 radii of the circle of equal
        area, is close to where three points hold a plate with the least sag.
    damping : RayleighDamping
    divisions, layers : int
        Elements along a side and through the thickness.
    """

    side: float = 0.72
    thickness: float = 0.045
    parent_radius: float = 60.0
    material: Material = GLASS_CERAMIC
    mount_radius: float = 0.432
    damping: RayleighDamping = DAMPING
    divisions: int = 10
    layers: int = 1


# Springs at each mount, N/m, for `on_springs`: the piston of the default segment, 153 kg, is near 50 Hz. Our
# choice; the reference gives none.
SEGMENT_SUPPORT = (5e6, 5e6, 5e6)

Mirror = CircularMirror | AnnularMirror | HexagonalSegment


def mirror_mesh(mirror: Mirror) -> Mesh:
    """Return the mesh of a mirror.

    Raises
    ------
    UserError
        If a dimension is not possible.
    """
    _check(mirror)
    if isinstance(mirror, HexagonalSegment):
        return hexagon_mesh(
            mirror.side,
            mirror.thickness,
            mirror.parent_radius / 2,
            mirror.mount_radius,
            mirror.divisions,
            mirror.layers,
        )
    if isinstance(mirror, AnnularMirror):
        return ring_mesh(
            mirror.inner_diameter / 2,
            mirror.diameter / 2,
            mirror.thickness,
            mirror.focal_length,
            mirror.mount_radius,
            mirror.mount_angles,
            mirror.around,
            mirror.rings,
            mirror.layers,
        )
    return disc_mesh(
        mirror.diameter / 2,
        mirror.thickness,
        mirror.focal_length,
        mirror.mount_radius,
        mirror.mount_angles,
        mirror.core,
        mirror.rings,
        mirror.layers,
    )


def circular_mirror(mirror: CircularMirror = CircularMirror()) -> FiniteElementModel:
    """Return the free-floating model of a circular mirror (7083 degrees of freedom by default).

    Raises
    ------
    UserError
        If a dimension is not possible, or the mounts lie on a line.
    """
    return _model("circular mirror", mirror)


def annular_mirror(mirror: AnnularMirror = AnnularMirror()) -> FiniteElementModel:
    """Return the free-floating model of an annular mirror; Raises as `circular_mirror`."""
    return _model("annular mirror", mirror)


def hexagonal_segment(mirror: HexagonalSegment = HexagonalSegment()) -> FiniteElementModel:
    """Return the free-floating model of a hexagonal segment; see `on_springs` for its supports."""
    return _model("hexagonal segment", mirror)


def on_springs(model: FiniteElementModel, stiffness: tuple[float, float, float]) -> FiniteElementModel:
    """Return the model with springs from each interface node to the ground.

    Parameters
    ----------
    model : FiniteElementModel
    stiffness : tuple of float
        Spring constants along x, y, z of each interface node, N/m.

    Raises
    ------
    UserError
        If a spring constant is negative or not finite.
    """
    springs = np.array(stiffness, dtype=float)
    if springs.shape != (3,) or not (np.isfinite(springs) & (springs >= 0)).all():
        raise UserError(
            f"the spring constants {stiffness} of the supports of {model.name} must be three numbers, "
            "not negative, in N/m"
        )
    inputs = model.inputs
    ground = inputs @ diags_array(np.tile(springs, len(model.interfaces))) @ inputs.T
    return replace(model, stiffness=csc_array(model.stiffness + ground))


def _model(name: str, mirror: Mirror) -> FiniteElementModel:
    mesh = mirror_mesh(mirror)
    try:
        mass, stiffness = assemble(mesh.nodes, mesh.elements, mirror.material)
    except UserError as error:
        raise UserError(
            f"the mesh of the {name} folds where it makes room for mounts at the radius "
            f"{mirror.mount_radius} m; take a finer mesh, or mounts farther from its edge"
        ) from error
    count = len(mesh.nodes)
    weights: NDArray[np.float64] = lumped_areas(mesh.nodes[:, :2], mesh.front_facets)[mesh.front_nodes]
    model = FiniteElementModel(
        name=name,
        mass=mass,
        stiffness=stiffness,
        damping=mirror.damping,
        nodes=mesh.nodes,
        dof_node=np.repeat(np.arange(count), 3),
        dof_direction=np.tile(np.arange(3), count),
        interfaces=mesh.mounts,
        surface_nodes=mesh.front_nodes,
        surface_weights=weights,
    )
    check_model(model)
    return model


def _check(mirror: Mirror) -> None:
    """Raise a UserError if a dimension is not possible."""
    what = type(mirror).__name__
    sizes = ("diameter", "inner_diameter", "thickness", "side", "mount_radius")
    for name in sizes:
        value = getattr(mirror, name, 1.0)
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"the {name} of the {what} is {value} m; it must be positive")
    if not getattr(mirror, "parent_radius", 1.0) > 0:
        raise UserError(f"the parent_radius of the {what} is {mirror.parent_radius} m; it must be positive")  # type: ignore[union-attr]
    if math.isnan(getattr(mirror, "focal_length", 1.0)):
        raise UserError(f"the focal_length of the {what} is no number (inf for a flat mirror)")
    for name in ("core", "rings", "layers", "around", "divisions"):
        value, least = getattr(mirror, name, 3), 3 if name == "around" else 1
        if value < least:
            raise UserError(f"{name} of the {what} is {value}; the mesh needs at least {least}")
    angles = getattr(mirror, "mount_angles", (0.0,))
    if not angles or not all(map(math.isfinite, angles)):
        raise UserError(
            f"the mount angles of the {what} are {angles}; give at least three finite numbers, in deg"
        )
    inner, outer = _mount_range(mirror)
    if not inner < outer:
        raise UserError(
            f"the inner diameter of the {what}, {2 * inner} m, must be less than its diameter, {2 * outer} m"
        )
    if not inner <= mirror.mount_radius <= outer:
        raise UserError(
            f"the mounts of the {what} at the radius {mirror.mount_radius} m lie outside the mirror, which "
            f"reaches from {inner} m to {outer} m"
        )
    focal_length = getattr(mirror, "focal_length", getattr(mirror, "parent_radius", math.inf) / 2)
    if abs(focal_length) < outer / 4:
        raise UserError(
            f"the focal length of the {what}, {focal_length} m, makes its rim steeper than 63 deg, which "
            f"degenerates the mesh; it must be at least {outer / 4} m, of a convex mirror with a minus sign"
        )


def _mount_range(mirror: Mirror) -> tuple[float, float]:
    if isinstance(mirror, HexagonalSegment):
        return 0.0, mirror.side
    return getattr(mirror, "inner_diameter", 0.0) / 2, mirror.diameter / 2
