"""Displacements of nodes from elsewhere: known motions and figures at scattered nodes come back."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import wavequake as wq
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.deck import write_deck
from wavequake.mechanics.mirrors.models import ALUMINUM, CircularMirror, mirror_mesh
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import notices

RADIUS, CURVATURE = 100.0, -1.0 / 2000.0  # mm: a paraboloid of 2 m radius
STUDY = """
[study]
name = "newton"
workflow = "system-disturbance"

[system]
name = "newton"
entrance_diameter_mm = 200.0
fields_arcmin = [[0.0, 0.0], [0.0, 10.0]]
wavelengths_nm = [550.0]
surface = [
    { name = "M1", radius_mm = -2000, conic = -1, glass = "mirror", semi_diameter_mm = 100, stop = true },
    { name = "flat", distance_mm = 800.0, tilt_deg = [45.0, 0.0, 0.0], glass = "mirror", fold = true },
    { name = "image", distance_mm = 200.0 },
]

[optics]
rays = 200

[wavefront]
zernike_terms = 15
"""
NODAL = """
[[disturbance]]
name = "thermal"
model = "nodal-displacements"
surface = "M1"
terms = 15
"""


def nodes(count=600, seed=1, radius=RADIUS):
    """Scattered points of the paraboloid, denser on one side."""
    random = np.random.default_rng(seed)
    rho, angle = radius * np.sqrt(random.uniform(0, 1, count)), 2 * np.pi * random.uniform(0, 1, count) ** 1.5
    x, y = rho * np.cos(angle), rho * np.sin(angle)
    return np.column_stack([x, y, CURVATURE / 2 * (x**2 + y**2)])


def figure(points, z5=0.0, z7=0.0, z11=0.0):
    """Astigmatism, coma and spherical aberration after Noll (1976), in the unit of the coefficients."""
    x, y = points[:, :2].T / RADIUS
    square = x**2 + y**2
    return (
        z5 * np.sqrt(6) * 2 * x * y
        + z7 * np.sqrt(8) * (3 * square - 2) * y
        + z11 * np.sqrt(5) * (6 * square**2 - 6 * square + 1)
    )


def displaced(points, shift_mm, angles, **coefficients_mm):
    """Where nodes go: they get a figure and then move, by finite angles about x, then y', then z''."""
    bent = points + np.column_stack([*np.zeros((2, len(points))), figure(points, **coefficients_mm)])
    return Rotation.from_euler("XYZ", angles).apply(bent) + shift_mm - points


def study(folder, text, **arrays):
    if arrays:
        np.savez(folder / "nodes.npz", **arrays)
    (folder / "study.toml").write_text(STUDY + text)
    return load_study(folder / "study.toml")


def moved(loaded, name="thermal"):
    return system_bench(loaded.identity_text()).layout.moved[name]


MOTIONS = (
    ([1e-3, -2e-3, 0.5e-3], [4e-6, -3e-6, 2e-6], {"z5": 3e-5, "z7": -2e-5, "z11": 1e-5}),
    ([0.3, 0.1, -0.2], [2e-3, 1e-3, -3e-3], {"z5": 3e-5}),  # so large that sines are no angles
    ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], {"z7": 2e-5}),
)


def test_known_motions_and_figures_come_back(tmp_path):
    points = nodes()
    steps = np.array([displaced(points, shift, angles, **form) for shift, angles, form in MOTIONS])
    loaded = study(
        tmp_path,
        NODAL + 'file = "nodes.npz"',
        nodes_mm=points,
        displacements_um=steps * 1e3,
        time_s=[0.0, 0.1, 0.4],
    )
    found = moved(loaded)
    for row, (shift, angles, form) in enumerate(MOTIONS):
        np.testing.assert_allclose(found.rigid[row, :3], np.array(shift) * 1e-3, atol=1e-16, rtol=1e-9)
        np.testing.assert_allclose(found.rigid[row, 3:], angles, atol=1e-16, rtol=1e-9)
        expected = np.zeros(15)
        expected[[4, 6, 10]] = [form.get(name, 0.0) * 1e-3 for name in ("z5", "z7", "z11")]
        np.testing.assert_allclose(found.figure[row], expected, atol=1e-15)
    (entry,) = loaded.disturbance
    assert (entry.instants, entry.duration_s) == (3, 0.4)
    assert "600 nodes: shifts by up to 374.2 um" in found.words
    assert any("thermal: M1 by 600 nodes" in line for line in notices(loaded))


def test_the_wavefront_is_that_of_the_motion_given_directly(tmp_path):
    """Of files in other units and axes: those of the system, of inches; of one load case of two."""
    points = nodes(400, 7)
    shift, angles, form = MOTIONS[0]
    move = displaced(points, shift, angles, **form)
    rows = [
        [case, k + 1, *(place / 25.4), *(step / 25.4 * (case - 1))]
        for case in (2, 3)
        for k, (place, step) in enumerate(zip(points, move, strict=True))
    ]
    np.savetxt(
        tmp_path / "cases.csv",
        [[row[0], row[1], *(np.array(row[2:5]) * 0.0254), *(np.array(row[5:]) * 25.4e3)] for row in rows],
        "%.17g",
        ",",
        header="case,node,x_m,y_m,z_m,dx_um,dy_um,dz_um",
        comments="",
    )
    np.savetxt(tmp_path / "star.txt", np.hstack([points, move]) / 25.4, "%.17g", header="x y z dx dy dz")
    direct = {f"M1.d{axis}_um": value * 1e3 for axis, value in zip("xyz", shift, strict=True)}
    direct |= {f"M1.r{axis}_urad": value * 1e6 for axis, value in zip("xyz", angles, strict=True)}
    direct |= {f"M1.{name}_nm": value * 1e6 for name, value in form.items()}
    (tmp_path / "direct.csv").write_text(
        ",".join(["time_s", *direct])
        + "\n"
        + ",".join(["0", *(f"{one:.17g}" for one in direct.values())])
        + "\n"
    )
    text = (
        NODAL
        + 'file = "cases.csv"\nload_case = 3\nscale = 0.5\nframe = "system"\nshare = 1\n'
        + NODAL.replace("thermal", "star")
        + 'file = "star.txt"\nunit = "in"\nshare = 1\n'
        + '[[disturbance]]\nname = "direct"\nmodel = "surface-history"\nfile = "direct.csv"\nshare = 1\n'
    )
    (tmp_path / "study.toml").write_text(STUDY + text)
    found = wq.run(tmp_path / "study.toml", store=tmp_path / "store", cases=3)
    assert found.zernike.attrs["units"] == "nm"
    zernike = found.zernike.values
    assert np.abs(found.wfe_change.values).min() > 10.0
    np.testing.assert_allclose(zernike[0], zernike[2], atol=1e-7)  # of 1e2 nm
    np.testing.assert_allclose(zernike[1], zernike[2], atol=1e-7)
    np.testing.assert_allclose(found.los_mm.values[0], found.los_mm.values[2], atol=1e-13)
    stored = json.loads(loaded_text(tmp_path))
    assert "file_npz" in stored["disturbance"][0]
    assert not {"file", "unit", "mesh"} & stored["disturbance"][1].keys()


def loaded_text(folder):
    return load_study(folder / "study.toml").identity_text()


def test_what_polynomials_leave_stands_on_a_grid(tmp_path):
    """A figure that 15 terms do not hold: a bump; the grid takes it up to what splines lose between nodes."""
    points = nodes(1200, 3)
    bump = 5e-5 * np.exp(-np.square(points[:, :2] - [30.0, -20.0]).sum(axis=1) / 2 / 15.0**2)
    shifts = np.column_stack([np.zeros((len(points), 2)), bump])
    loaded = study(
        tmp_path, NODAL + 'file = "nodes.npz"\ngrid = 65', nodes_mm=points, displacements_um=shifts * 1e3
    )
    bench = system_bench(loaded.identity_text())
    found = bench.layout.moved["thermal"]
    grid = bench.system.surfaces[0].deformation.residual
    assert found.grid.shape == (1, 65, 65)
    axis = np.linspace(-1, 1, 65) * grid.dx * 32
    x, y = np.meshgrid(axis, axis)
    from wavequake.optics.polynomials.zernike import annular_zernike

    inside = np.hypot(x, y) < 0.9 * RADIUS
    fitted = annular_zernike(x[inside] / RADIUS, y[inside] / RADIUS, 15, 0.0) @ found.figure[0]
    rigid = found.rigid[0, 2] + found.rigid[0, 3] * y[inside] * 1e-3 - found.rigid[0, 4] * x[inside] * 1e-3
    whole = (fitted + rigid + found.grid[0][inside]) * 1e3
    expected = 5e-5 * np.exp(-((x - 30.0) ** 2 + (y + 20.0) ** 2) / 2 / 15.0**2)[inside]
    assert np.abs(whole - expected).max() < 0.02 * 5e-5
    assert "no sum of 15 terms (on a grid" in found.words


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nodes_mm": nodes() * 25.4}, "none of 600 nodes|nodes within 100 mm do not lie on the surface"),
        ({"nodes_mm": nodes()[:, [2, 0, 1]]}, "do not lie on the surface, the farthest"),
        (
            {"nodes_mm": nodes()[:9], "displacements_um": np.ones((9, 3))},
            "9 optical nodes do not determine",
        ),
        (
            {"displacements_um": np.full((600, 3), np.nan)},
            "holds what is no finite number",
        ),
        ({"displacements_um": np.ones((2, 600, 3))}, "load_case must say which of the load cases 1, 2"),
        ({"displacements_um": np.ones((2, 599, 3))}, r"must be \(p, 3\) and \(n, p, 3\)"),
        ({"time_s": []}, "0.1 and 0.1 s do not increase"),
    ],
)
def test_bad_nodes_are_refused(tmp_path, change, words):
    arrays = {"nodes_mm": nodes(), "displacements_um": np.ones((600, 3))} | change
    if "time_s" in change:
        arrays["displacements_um"], arrays["time_s"], words = (
            np.ones((2, 600, 3)),
            [0.1, 0.1],
            "do not increase",
        )
    with pytest.raises(UserError, match=words):
        system_bench(study(tmp_path, NODAL + 'file = "nodes.npz"', **arrays).identity_text())


def test_nodes_off_the_surface_are_left_out_where_asked(tmp_path):
    both = np.vstack([nodes(), nodes(seed=2) + np.array([0.0, 0.0, 12.0])])
    steps = np.vstack([np.full((600, 3), 2.0), np.full((600, 3), -7.0)])
    found = moved(
        study(tmp_path, NODAL + 'file = "nodes.npz"\noff_mm = 0.01', nodes_mm=both, displacements_um=steps)
    )
    assert "beyond" not in found.words
    np.testing.assert_allclose(found.rigid[0], [2e-6, 2e-6, 2e-6, 0, 0, 0], atol=1e-15)


def test_nodes_that_end_before_the_rim_are_told(tmp_path):
    inner = nodes(radius=0.8 * RADIUS)
    found = moved(
        study(tmp_path, NODAL + 'file = "nodes.npz"', nodes_mm=inner, displacements_um=np.ones((600, 3)))
    )
    assert "beyond 80% of the radius there are no nodes" in found.words


def test_temperatures_of_a_mirror_change_its_radius_by_its_expansion(tmp_path):
    """A free mirror 25 K warmer has the radius R (1 + alpha dT); a gradient g adds the curvature alpha g."""
    mesh = mirror_mesh(
        CircularMirror(diameter=0.2, thickness=0.02, focal_length=-1.0, core=2, rings=4, mount_radius=0.06)
    )
    write_deck(tmp_path / "mirror.inp", mesh, ALUMINUM)
    x, y, z = mesh.nodes.T
    alpha, warmer, gradient = 2.3e-5, 25.0, 40.0
    np.savez(
        tmp_path / "temperatures.npz",
        nodes_mm=mesh.nodes * 1e3,
        temperatures_c=[20.0 + warmer + 0 * z, 20.0 + gradient * z],
    )
    bent = np.column_stack([x * z, y * z, (z**2 - x**2 - y**2) / 2])[mesh.front_nodes]
    front = mesh.nodes[mesh.front_nodes]
    np.savez(
        tmp_path / "exact.npz",
        nodes_mm=front * 1e3,
        displacements_um=1e6 * alpha * np.stack([warmer * front, gradient * bent]),
    )
    thermal = f'thermal = {{ expansion_per_k = {alpha}, reference = 20, nodes = "SURFACE" }}\n'
    text = NODAL + 'file = "temperatures.npz"\nmesh = "mirror.inp"\nunit = "m"\n' + thermal
    text += NODAL.replace("thermal", "exact") + 'file = "exact.npz"\n'
    for case in (1, 2):
        loaded = study(tmp_path, text.replace("terms = 15", f"terms = 15\nload_case = {case}"))
        found, exact = moved(loaded), moved(loaded, "exact")
        np.testing.assert_allclose(found.figure, exact.figure, rtol=0, atol=2e-4 * np.abs(exact.figure).max())
        np.testing.assert_allclose(found.rigid[0, 3:], 0.0, atol=1e-12)
        if case == 1:  # sag at the rim 2.5 mm less by alpha dT, as defocus sqrt(3) (2 rho^2 - 1)
            shallower = alpha * warmer * 2.5e-3 / (2 * np.sqrt(3))
            np.testing.assert_allclose(found.figure[0, 3], shallower, rtol=1e-3)
    assert "thermal" not in json.loads(loaded.identity_text())["disturbance"][0]
    assert any(
        "as in mirror.inp, in its units: GLASS has Poisson's ratio 0.33" in one for one in notices(loaded)
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds temperatures; what they do is said by thermal"),
        (
            "thermal = { expansion_per_k = 1e-5, reference = 20 }\n",
            "name the key mesh, a deck with the elements",
        ),
        ("thermal = { expansion = 1e-5 }\n", "thermal.reference: field required"),
        (
            'thermal = { expansion_per_k = 1e-5, reference = 20 }\nmesh = "temperatures.csv"\n',
            "name unit, that of the mesh",
        ),
    ],
)
def test_temperatures_without_a_body_are_refused(tmp_path, text, words):
    (tmp_path / "temperatures.csv").write_text("x_mm,y_mm,z_mm,temperature_c\n0,0,0,20\n")
    with pytest.raises(UserError, match=words):
        study(tmp_path, NODAL + 'file = "temperatures.csv"\n' + text)
