"""Segments, M1's cell and M2 on bodies of mass: the parts of small study files."""

import numpy as np
from small_bodies import legs, study_of

from wavequake.workflows.segments.disturbance import KIND

STUDY = """
[study]
name = "carried"
workflow = "segment-disturbance"
seed = 3
[telescope]
name = "tmt-18"
[campaign]
cases = 1
[imaging]
enabled = false
[optics]
rays_per_segment = 6
[wavefront]
zernike_terms = 11
"""
CELL = """
[[body]]
name = "cell"
surfaces = ["M1"]
[body.rigid]
mass_kg = 1e5
inertia_kg_m2 = [5e6, 5e6, 1e7]
[body.rigid.nodes_mm]
a = [10000.0, 0.0, 2000.0]
b = [-5000.0, 9000.0, 2000.0]
c = [-5000.0, -9000.0, 2000.0]
[[link]]
name = "feet"
kind = "springs"
joins = [["cell.a", "ground"], ["cell.b", "ground"], ["cell.c", "ground"]]
stiffness_n_m = 1e9
"""
TOP = """
[[body]]
name = "top"
surfaces = ["M2"]
[body.rigid]
mass_kg = 3000.0
inertia_kg_m2 = [3e3, 3e3, 6e3]
[body.rigid.nodes_mm]
a = [1500.0, 0.0, -27093.75]
b = [-1500.0, 0.0, -27093.75]
c = [0.0, 1500.0, -27093.75]
d = [0.0, -1500.0, -27093.75]
"""
SPIDER = """
[[link]]
name = "spider"
kind = "springs"
joins = [["top.a", "ground"], ["top.b", "ground"], ["top.c", "ground"], ["top.d", "ground"]]
stiffness_n_m = [2e7, 3e7, 4e7]
"""
SECONDARY = """
[[body]]
name = "secondary"
surfaces = ["M2"]
[body.mirror]
thickness_m = 0.2
diameter_m = 3.04
mount_radius_m = 0.98
rings = 3
figure_terms = 21
"""
M2_ELASTIC = SECONDARY + legs("secondary", 2e8, 1500.0, -28500.0)


def text_of(folder, *parts, **overrides):
    return study_of(folder, *parts, **overrides).identity_text()


def numbers(text, kind=KIND):
    return kind.compute(text, np.arange(1), "numpy").arrays
