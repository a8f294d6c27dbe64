"""A study of eighteen segments: five populations, small images."""

STUDY = """
[study]
name = "small"
workflow = "segment-disturbance"
seed = 7
[telescope]
name = "tmt-18"
gap_mm = 20.0
[imaging]
pixels = 32
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 20.0
tip_nrad = 5.0
tilt_nrad = 5.0
instants = 3
share = 2
[[disturbance]]
name = "mount"
model = "line-of-sight"
act = "mount"
instants = 20
duration_s = 60.0
[[disturbance]]
name = "m2"
model = "line-of-sight"
act = "m2"
instants = 5
duration_s = 60.0
[[disturbance]]
name = "figure"
model = "static-random"
instants = 2
figure_nm = { 4 = 20.0, 6 = 10.0 }
[[disturbance]]
name = "both"
model = "combine"
of = ["pistons", "figure"]
instants = 2
"""
