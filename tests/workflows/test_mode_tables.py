"""Tables of modes as bodies: the light sees the shape of each mode, which answers as an oscillator does."""

import numpy as np
import pytest
from study_text import force

import wavequake as wq
from wavequake.errors import UserError
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench

STUDY = """
[study]
name = "newton"
workflow = "system-disturbance"

[system]
name = "newton"
entrance_diameter_mm = 200.0
wavelengths_nm = [550.0]
surface = [
    { name = "M1", radius_mm = -2000, conic = -1, glass = "mirror", semi_diameter_mm = 100, stop = true },
    { name = "image", distance_mm = 1000.0 },
]

[optics]
rays = 60

[wavefront]
zernike_terms = 11

[[body]]
name = "primary"
surfaces = ["M1"]

[body.modes]
file = "modes.csv"
figure_terms = 11
damping_ratios = 0.01
"""
STUDY += force("primary.1", 10.0, 2.0, name="push", direction=[0.0, 0.0, 1.0], instants=32, duration_s=0.5)
MASS = 5.0
NOLL5 = 3e-3  # 1/sqrt(kg): of a figure of 1 m per root of modal mass


def table(folder):
    """Mode 1: the mirror goes up and down at 25 Hz; mode 2: it bends by astigmatism at 300 Hz."""
    random = np.random.default_rng(1)
    rho, angle = 100 * np.sqrt(random.uniform(0, 1, 200)), random.uniform(0, 2 * np.pi, 200)
    x, y = rho * np.cos(angle), rho * np.sin(angle)
    z = -(x**2 + y**2) / 4000
    shapes = (np.full(200, 1 / np.sqrt(MASS)), NOLL5 * np.sqrt(6) * 2 * x * y / 1e4)
    rows = [
        f"{mode},{frequency},{k + 1},{x[k]!r},{y[k]!r},{z[k]!r},0,0,{shape[k]!r}"
        for mode, frequency, shape in ((1, 25, shapes[0]), (2, 300, shapes[1]))
        for k in range(200)
    ]
    rows += [
        f"{mode},{hz},999,0,0,40,0,0,{3.0 * mode}" for mode, hz in ((1, 25), (2, 300))
    ]  # off the surface
    head = "mode,frequency_hz,node,x_mm,y_mm,z_mm,dx,dy,dz"
    (folder / "modes.csv").write_text(
        "\n".join([head, *rows, ""]).replace("np.float64(", "").replace(")", "")
    )
    return shapes


def test_the_first_surface_moves_and_deforms_with_the_modes(tmp_path):
    shapes = table(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY)
    loaded = load_study(tmp_path / "study.toml")
    plant = system_bench(loaded.identity_text()).plants["full"]
    np.testing.assert_allclose(plant.omega / 2 / np.pi, [25.0, 300.0], rtol=1e-12)
    rigid = plant.shapes[plant.outputs["rigid", "primary"]]
    figure = plant.shapes[plant.outputs["figure", "M1"]]
    sign = np.sign([rigid[2, 0], figure[4, 1]])
    np.testing.assert_allclose(rigid[:, 0] * sign[0], [0, 0, 1 / np.sqrt(MASS), 0, 0, 0], atol=1e-12)
    # The best rigid motion of scattered nodes has a little of the astigmatism; it is put back by the figure.
    np.testing.assert_allclose(figure[4, 1] * sign[1], NOLL5, rtol=2e-2)
    np.testing.assert_allclose(figure[:, 0], 0.0, atol=1e-12)
    found = wq.run(tmp_path / "study.toml", store=tmp_path / "store", cases=2)
    # A force of 2 N at node 1 far below both resonances: each mode answers as a spring does.
    amplitude = [
        2.0 * shape[0] / abs((2 * np.pi) ** 2 * (f**2 - 10.0**2 + 2j * 0.02 * 10 * f))
        for shape, f in zip(shapes, (25.0, 300.0), strict=True)
    ]
    seen = found.zernike.sel(noll=5).values[..., 0, 0]
    np.testing.assert_allclose(np.ptp(seen, axis=1) / 2, 2e9 * NOLL5 * abs(amplitude[1]), rtol=3e-2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("figure_terms = 11", "figure_terms = 11\nunits = 'm,kg,s,N'"), "primary.modes: .*leave units"),
        (("figure_terms = 11", "figure_terms = 11\nnodes = [1, 2000]"), "primary.modes: .*no node 2000"),
        (
            ("figure_terms = 11", "figure_terms = 220"),
            "200 optical nodes do not determine 220",
        ),
        (('"modes.csv"', '"modes.op2"'), "primary.modes: the units of modes.op2 are not declared"),
        (('surfaces = ["M1"]\n', ""), "no surface to which figure_terms could be fitted"),
    ],
)
def test_bad_bodies_are_refused(tmp_path, change, words):
    table(tmp_path)
    (tmp_path / "study.toml").write_text(STUDY.replace(*change))
    with pytest.raises(UserError, match=words):
        system_bench(load_study(tmp_path / "study.toml").identity_text())
