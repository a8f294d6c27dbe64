"""Bodies of mass, their links, and what shakes them: the parts of small study files."""

from pathlib import Path

import numpy as np

from wavequake.mechanics.disturbances.registry import instants_of
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import draw


def shaken(keys, instants=16):
    """Return a disturbance of 0.2 s."""
    return f'[[disturbance]]\nname = "one"\nduration_s = 0.2\ninstants = {instants}\n{keys}\n'


def floor(amplitude, hertz=1e-3):
    """Return a floor that moves as a sinusoid."""
    line = f"{{ frequency_hz = {hertz}, amplitude = {{ {amplitude} }} }}"
    return shaken(f'model = "base-motion"\nlines = [{line}]')


def legs(body, stiffness, radius, height):
    """Return six legs of a mirror to points of the ground on a circle (mm), two to each of its mounts."""
    angles = np.deg2rad(60.0 * np.arange(6) + 30.0)
    places = zip("abcdef", radius * np.cos(angles), radius * np.sin(angles), strict=True)
    ground = "".join(f"{name} = [{x:.1f}, {y:.1f}, {height}]\n" for name, x, y in places)
    return f"""
[[link]]
name = "legs"
kind = "legs"
joins = [
    ["{body}.1", "ground.f"], ["{body}.1", "ground.a"], ["{body}.2", "ground.b"],
    ["{body}.2", "ground.c"], ["{body}.3", "ground.d"], ["{body}.3", "ground.e"],
]
stiffness_n_m = {stiffness}
[structure.ground_mm]
{ground}"""


# Three springs from a body to the ground about its axis.
SPRINGS = """[[link]]
name = "feet"
kind = "springs"
joins = [["BODY", "ground.a"], ["BODY", "ground.b"], ["BODY", "ground.c"]]
stiffness_n_m = 1e5
[structure.ground_mm]
a = [50.0, 0.0, 0.0]
b = [-50.0, 0.0, 0.0]
c = [0.0, 50.0, 0.0]
"""


# A parabola of 1 m focal length; the image, a meter before it, on a camera that is welded to the cell.
OPTICS = """
[study]
name = "bench"
workflow = "system-disturbance"
[system]
entrance_diameter_mm = 100.0
wavelengths_nm = [500.0]
[[system.surface]]
name = "M1"
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = 55.0
stop = true
[[system.surface]]
name = "image"
distance_mm = 1000.0
[optics]
rays = 60
[wavefront]
zernike_terms = 11
[campaign]
cases = 4
"""
CELL = """
[[body]]
name = "cell"
surfaces = ["M1"]
[body.rigid]
mass_kg = 8.0
inertia_kg_m2 = [2.0, 3.0, 4.0]
[body.rigid.nodes_mm]
a = [300.0, 0.0, 0.0]
b = [-300.0, 0.0, 0.0]
c = [0.0, 300.0, 0.0]
d = [0.0, -300.0, 0.0]
"""
CAMERA = """
[[body]]
name = "camera"
surfaces = ["image"]
[body.rigid]
mass_kg = 2.0
inertia_kg_m2 = [1.0, 1.0, 1.0]
"""
FEET = """
[[link]]
name = "feet"
kind = "springs"
joins = [["cell.a", "ground"], ["cell.b", "ground"], ["cell.c", "ground"], ["cell.d", "ground"]]
stiffness_n_m = [2e5, 3e5, 4e5]
"""
WELD = """
[[link]]
name = "weld"
kind = "rigid"
joins = [["cell.a", "camera"]]
[structure]
damping_ratio = 0.02
"""
RIGID = CELL + CAMERA + FEET + WELD
# The mirror itself is elastic, on three pairs of legs.
MIRROR = """
[[body]]
name = "primary"
surfaces = ["M1"]
[body.mirror]
thickness_m = 0.004
mount_radius_m = 0.035
rings = 4
figure_terms = 11
"""
ELASTIC = MIRROR + legs("primary", 1e7, 50.0, 60.0)
SLOW = floor("rx_urad = 3.0")
Z_FORCE = shaken(
    'model = "body-force"\nat = ["cell"]\ndirection = [0.0, 0.0, 2.0]\n'
    "lines = [{ frequency_hz = 30.0, force_n = 0.5 }]"
)


def study_of(folder, *parts, **overrides):
    path = Path(folder) / "study.toml"
    path.write_text("\n".join(parts))
    return load_study(path, {key.replace("__", "."): value for key, value in overrides.items()})


def drawn(study, case=0):
    """Return the instants and the motion of a case."""
    population, motion = draw(system_bench(study.identity_text()), case)
    return instants_of(study.disturbance, population), motion


def amplitude(time, values, frequency):
    """Return the complex amplitude of what is a sinusoid of a frequency."""
    phase = 2.0 * np.pi * frequency * time
    basis = np.column_stack([np.cos(phase), -np.sin(phase)])
    found, *_ = np.linalg.lstsq(basis, values)
    np.testing.assert_allclose(basis @ found, values, atol=1e-9 * np.abs(values).max())
    return complex(*found)
