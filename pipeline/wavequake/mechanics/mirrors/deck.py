"""Decks for CalculiX: the same mesh in an independent solver. SI units."""

from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.mesh import Mesh

# Both have 20 nodes; R is integrated with 2x2x2 points, in stiffness and mass alike.
ELEMENTS = ("C3D20", "C3D20R")


def _rows(numbers: Iterable[int], per_line: int) -> list[str]:
    """Lines of comma-separated numbers; a comma at the end continues the entry on the next line."""
    words = [str(number) for number in numbers]
    lines = [", ".join(words[start : start + per_line]) for start in range(0, len(words), per_line)]
    return [line + "," for line in lines[:-1]] + lines[-1:]


def write_deck(
    path: Path,
    mesh: Mesh,
    material: Material,
    element: str = "C3D20R",
    modes: int = 0,
    node_sets: Mapping[str, NDArray[np.int64]] | None = None,
) -> None:
    """Write an input deck of the free body for CalculiX (also read by meshio and, mostly, by Abaqus).

    The sets INTERFACES and SURFACE hold the mounts and the optical surface. Nodes are numbered from 1.

    Parameters
    ----------
    path : Path
        File that ends in .inp.
    mesh : Mesh
    material : Material
    element : str
        C3D20R or C3D20.
    modes : int
        Number of eigenfrequencies that CalculiX shall compute; 0 asks it to store the matrices instead, in
        files that end in .sti, .mas and .dof.
    node_sets : mapping of str to ndarray of int, optional
        Further sets; nodes are numbered from 0 here.

    Raises
    ------
    UserError
        If the element is not known.
    """
    if element not in ELEMENTS:
        raise UserError(f"the element {element!r} is not known; use {' or '.join(ELEMENTS)}")
    sets = {"INTERFACES": mesh.mounts, "SURFACE": mesh.front_nodes} | dict(node_sets or {})
    lines = ["*NODE, NSET=ALL"]
    lines += [
        f"{number}, {x:.12e}, {y:.12e}, {z:.12e}" for number, (x, y, z) in enumerate(mesh.nodes.tolist(), 1)
    ]
    lines.append(f"*ELEMENT, TYPE={element}, ELSET=BODY")
    # 16 numbers a line at most: the element's own, ten nodes, and ten more.
    lines += chain.from_iterable(
        _rows([number, *nodes], 11) for number, nodes in enumerate((mesh.elements + 1).tolist(), 1)
    )
    for name, nodes in sets.items():
        lines += [f"*NSET, NSET={name}", *(f"{node}," for node in (nodes + 1).tolist())]
    lines += [
        "*MATERIAL, NAME=GLASS",
        "*ELASTIC",
        f"{material.young!r}, {material.poisson!r}",
        "*DENSITY",
        f"{material.density!r}",
        "*SOLID SECTION, ELSET=BODY, MATERIAL=GLASS",
        "*STEP",
        "*FREQUENCY" if modes else "*FREQUENCY, SOLVER=MATRIXSTORAGE",
        str(modes or 1),
        "*END STEP",
    ]
    path.write_text("\n".join(lines) + "\n")
