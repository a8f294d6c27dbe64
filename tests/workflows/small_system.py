"""A parabola of 1 m; a small Cassegrain that is shaken, and loops that steer its M2."""

from study_text import controller, part, steered

PARABOLA = """
[study]
name = "parabola"
workflow = "system-disturbance"
[system]
entrance_diameter_mm = 100.0
fields_arcmin = [[0.0, 0.0], [3.0, 0.0]]
wavelengths_nm = [500.0, 1000.0]
[[system.surface]]
name = "mirror"
radius_mm = -2000.0
conic = -1.0
glass = "mirror"
stop = true
[[system.surface]]
name = "image"
distance_mm = 1000.0
"""
SYSTEM = """
[system]
name = "cassegrain"
entrance_diameter_mm = 1000.0
pupil_obscuration = 0.25
fields_arcmin = [[0.0, 0.0]]
wavelengths_nm = [550.0]

[[system.surface]]
name = "M1"
radius_mm = -5000.0
conic = -1.0
glass = "mirror"
semi_diameter_mm = 500.0
stop = true

[[system.surface]]
name = "M2"
distance_mm = 1940.0
radius_mm = -1493.3333333333333
conic = -2.7777777777777777
glass = "mirror"
semi_diameter_mm = 130.0

[[system.surface]]
name = "image"
distance_mm = 2240.0

[optics]
rays = 100

[wavefront]
zernike_terms = 11

[campaign]
cases = 2
device = "numpy"
"""
SHAKEN = """
[[disturbance]]
name = "shaken"
model = "surface-vibration"
of = ["M1"]
duration_s = 1.0
instants = 16
lines = [{ frequency_hz = 20.0, amplitude = { dx_um = 1.0, ry_urad = 0.2 } }]
"""
IMAGES = """
[imaging]
pixels = 32
sampling = 0.25
"""
LOOP = steered("M2", ["rx", "ry"], 1000.0)
INTEGRATOR = controller("integrator", "integrator", "sight", "stage", gain=0.3)
PERFECT = INTEGRATOR.replace("integrator", "perfect").replace("gain = 0.3\n", "")


def hum(surface, instants, **amplitude):
    """Return a vibration of a surface at 10 Hz."""
    lines = [{"frequency_hz": 10.0, "amplitude": amplitude}]
    keys = {"name": "hum", "model": "surface-vibration", "of": [surface]}
    return part("disturbance", **keys, instants=instants, lines=lines)
