"""What a user should check of an imported model: units that do not fit its files are coherent, but absurd."""

from collections.abc import Iterator

import numpy as np
import scipy  # its parts load when first used
from scipy.spatial import ConvexHull, QhullError

from wavequake.mechanics.model import Array, FiniteElementModel
from wavequake.mechanics.vibration.eigen import rigid_motions
from wavequake.mechanics.vibration.factors import LARGE
from wavequake.mechanics.vibration.forecast import forecast
from wavequake.reduction.intermediate import Intermediate

# Sizes in m and densities in kg/m^3 (of all mass in the convex hull of all nodes) beyond which the units are
# doubtful: the smallest and largest mirrors, lightweighted glass and platinum.
_SIZES, _DENSITIES = (1e-3, 100.0), (50.0, 25e3)
_SHOWN = 5


def facts(model: FiniteElementModel, units: str, notes: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield sentences about size, mass and what the import did; warnings where units are doubtful.

    Parameters
    ----------
    model : FiniteElementModel
        In SI units.
    units : str
        As declared.
    notes : tuple of str
        Of the import.
    """
    extent, mass = np.ptp(model.nodes, axis=0), total_mass(model)
    yield (
        f"imported model: {len(model.nodes)} nodes, {model.stiffness.shape[0]} degrees of freedom, "
        f"{' x '.join(f'{1e3 * size:.4g}' for size in extent)} mm, {mass:.4g} kg (units {units})"
    )
    yield from (f"imported model: {note}" for note in notes)
    if model.order >= LARGE:
        yield f"imported model: {forecast(model.stiffness).size}"
    doubt = f"are model.units = '{units}' those of the files?"
    if not _SIZES[0] <= extent.max() <= _SIZES[1]:
        yield f"warning: the model is {1e3 * extent.max():.3g} mm wide; {doubt}"
    volume = hull_volume(model.nodes)
    if volume > 0.0 and not _DENSITIES[0] <= mass / volume <= _DENSITIES[1]:
        yield (
            f"warning: {mass:.3g} kg in the convex hull of the nodes are {mass / volume:.3g} kg/m3, too "
            f"{'light' if mass / volume < _DENSITIES[0] else 'heavy'} for a solid; {doubt}"
        )


def frequencies(stage: Intermediate) -> str:
    """Return a sentence about rigid motions and the first elastic frequencies."""
    squared = scipy.linalg.eigh(stage.stiffness, stage.mass, eigvals_only=True)
    rigid = stage.rigid.shape[1]
    elastic = np.sqrt(np.maximum(squared[rigid : rigid + _SHOWN], 0.0)) / (2.0 * np.pi)
    return f"{rigid} rigid motions, then {', '.join(f'{one:.4g}' for one in elastic)} Hz"


def total_mass(model: FiniteElementModel) -> float:
    """Return the mass in kg: the largest of those that move along x, y and z, for supports hold some."""
    moves = rigid_motions(model, np.zeros(3))[:, :3]
    return float(np.einsum("nd,nd->d", moves, np.asarray(model.mass @ moves)).max())


def hull_volume(nodes: Array) -> float:
    """Return the volume of the convex hull, m^3; 0 for nodes in a plane."""
    try:
        return float(ConvexHull(nodes).volume)
    except QhullError:
        return 0.0
