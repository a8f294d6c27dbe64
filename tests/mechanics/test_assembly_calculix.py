"""An assembly of elastic mirrors and legs against CalculiX, where the program is installed."""

import shutil
from dataclasses import replace

import calculix_decks
import numpy as np
import pytest

from wavequake.mechanics.assembly.bodies import placed
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import plant
from wavequake.mechanics.mirrors.hexahedra import assemble
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror, mirror_mesh

MOUNTS = {str(one): one for one in range(3)}


@pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed (Debian package calculix-ccx)")
def test_an_assembly_of_mirrors_on_legs_has_the_frequencies_of_calculix(tmp_path):
    """A mirror on six legs to the ground, and a smaller one on six legs on it."""
    large, small = (
        CircularMirror(diameter=size, thickness=0.02, mount_radius=radius, core=1, rings=2)
        for size, radius in ((1.0, 0.33), (0.4, 0.13))
    )
    lift, stiffness = 0.3, (4e6, 1e6)
    angles = np.deg2rad(np.arange(6) * 60.0 + 30.0)
    feet = np.column_stack([0.45 * np.cos(angles), 0.45 * np.sin(angles), np.full(6, -0.25)])
    pairs = [(mount, foot) for mount in range(3) for foot in ((2 * mount - 1) % 6, 2 * mount)]
    bodies = [
        placed("large", _model(large), MOUNTS),
        placed("small", _model(small), MOUNTS, None, np.array([0.0, 0.0, lift])),
    ]
    below = [
        Link("below", "leg", End("large", str(mount)), End("ground", str(foot)), (stiffness[0],) * 3)
        for mount, foot in pairs
    ]
    between = [
        Link("between", "leg", End("small", str(one)), End("large", str(other)), (stiffness[1],) * 3)
        for one in range(3)
        for other in range(3)
        if one != other
    ]
    found = plant(bodies, [*below, *between], {str(foot): point for foot, point in enumerate(feet)})
    calculix_decks.run(tmp_path, _assembly_deck((large, small), lift, feet, pairs, stiffness), 30)
    expected = np.array(calculix_decks.frequencies(tmp_path), dtype=float)
    np.testing.assert_allclose(found.omega[: len(expected)] / (2 * np.pi), expected, rtol=6e-7)


def _model(mirror):
    """With the same Gauss points for stiffness and mass, as CalculiX has them."""
    mesh = mirror_mesh(mirror)
    mass, stiffness = assemble(mesh.nodes, mesh.elements, mirror.material, 3, 3)
    return replace(circular_mirror(mirror), mass=mass, stiffness=stiffness)


def _nodes(first, points):
    return [f"{first + i}, {x:.12e}, {y:.12e}, {z:.12e}" for i, (x, y, z) in enumerate(points.tolist())]


def _assembly_deck(mirrors, lift, feet, pairs, stiffness):
    """The same, with nodes of the second mirror from 10001 and feet from 20001."""
    lines, legs = [], []
    mounts = []
    for number, mirror in enumerate(mirrors):
        mesh, first = mirror_mesh(mirror), 10_000 * number + 1
        mounts.append(mesh.mounts + first)
        lines += ["*NODE, NSET=ALL", *_nodes(first, mesh.nodes + np.array([0.0, 0.0, lift * number]))]
        lines.append(f"*ELEMENT, TYPE=C3D20, ELSET=B{number}")
        for i, element in enumerate((mesh.elements + first).tolist()):
            lines.append(f"{first + i}, " + ", ".join(map(str, element[:10])) + ",")
            lines.append(", ".join(map(str, element[10:])))
    lines += ["*NODE, NSET=FEET", *_nodes(20_001, feet)]
    legs.append([(mounts[0][mount], 20_001 + foot) for mount, foot in pairs])
    legs.append([(mounts[1][a], mounts[0][b]) for a in range(3) for b in range(3) if a != b])
    for number, (ends, constant) in enumerate(zip(legs, stiffness, strict=True)):
        lines.append(f"*ELEMENT, TYPE=SPRINGA, ELSET=LEGS{number}")
        lines += [f"{30_001 + 100 * number + i}, {a}, {b}" for i, (a, b) in enumerate(ends)]
        lines += [f"*SPRING, ELSET=LEGS{number}", "", f"{constant!r}"]
    material = "*MATERIAL, NAME=AL\n*ELASTIC\n70e9, 0.33\n*DENSITY\n2700.\n"
    sections = [f"*SOLID SECTION, ELSET=B{number}, MATERIAL=AL" for number in range(2)]
    return "\n".join([*lines, material.rstrip(), *sections, "*BOUNDARY", "FEET, 1, 3", ""])
