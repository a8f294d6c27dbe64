"""A free space truss of four nodes and six bars, whose matrices follow from closed forms. SI units.

Its node numbers have gaps, as those of real meshes do.
"""

from itertools import combinations

import numpy as np

NUMBERS = np.array([3, 8, 21, 40])
POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.25, 1.0, 0.0], [0.5, 0.5, 1.5]])
DOFS = np.array([(number, direction) for number in NUMBERS for direction in (1, 2, 3)])
DECK = """*NODE, NSET=ALL
3, 0., 0., 0.
8, 1., 0., 0.
** a comment
21, 0.25, 1., 0.
40, 0.5, 0.5, 1.5
*ELEMENT, TYPE=C3D4, ELSET=BODY
1, 3, 8, 21, 40
*NSET, NSET=MOUNTS
3, 8,
21
*NSET, NSET=MIRROR
40, 3, 8
"""


def matrices():
    """Return stiffness (E A = 2e6 N) and consistent mass (rho A = 3 kg/m), shape (12, 12)."""
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    for pair in combinations(range(4), 2):
        bar = POINTS[pair[1]] - POINTS[pair[0]]
        length = np.linalg.norm(bar)
        along = np.outer(bar, bar) / length**2
        rows = np.concatenate([3 * node + np.arange(3) for node in pair])
        stiffness[np.ix_(rows, rows)] += 2e6 / length * np.kron([[1, -1], [-1, 1]], along)
        mass[np.ix_(rows, rows)] += 3.0 * length / 6 * np.kron([[2, 1], [1, 2]], np.eye(3))
    return stiffness, mass


def write_deck(path):
    path.write_text(DECK)


def write_dofs(path, dofs=DOFS):
    path.write_text("".join(f"{node}.{direction}\n" for node, direction in dofs))


def write_triangle(path, matrix):
    """Write the upper triangle as CalculiX does, column by column."""
    rows = [(i, j) for j in range(len(matrix)) for i in range(j + 1)]
    path.write_text("".join(f"{i + 1} {j + 1}  {matrix[i, j]:.17e}\n" for i, j in rows))
