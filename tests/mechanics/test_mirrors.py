from dataclasses import replace
from math import inf, nan, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import ivp, jvp

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.hexahedra import assemble
from wavequake.mechanics.mirrors.models import (
    SEGMENT_SUPPORT,
    AnnularMirror,
    CircularMirror,
    HexagonalSegment,
    annular_mirror,
    circular_mirror,
    hexagonal_segment,
    mirror_mesh,
    on_springs,
)
from wavequake.mechanics.model import rigid_modes
from wavequake.mechanics.vibration.eigen import eigenmodes

BUILD = {
    CircularMirror: circular_mirror,
    AnnularMirror: annular_mirror,
    HexagonalSegment: hexagonal_segment,
}
DEFAULTS = [CircularMirror(), AnnularMirror(), HexagonalSegment()]
NAMES = ["circular", "annular", "hexagonal"]
AREAS = [pi / 4, pi / 4 * (1 - 0.4**2), 1.5 * sqrt(3) * 0.72**2]


def build(mirror):
    return BUILD[type(mirror)](mirror)


@pytest.mark.parametrize(("mirror", "area"), list(zip(DEFAULTS, AREAS, strict=True)), ids=NAMES)
def test_mass_is_that_of_the_volume(mirror, area):
    model = build(mirror)
    expected = mirror.material.density * area * mirror.thickness
    # Circles are made of parabolic arcs; a hexagon has straight sides.
    tolerance = 1e-12 if isinstance(mirror, HexagonalSegment) else 5e-6
    assert model.mass.sum() / 3 == pytest.approx(expected, rel=tolerance)


def test_inertia_of_a_flat_disc_and_ring():
    for mirror, inner in ((CircularMirror(focal_length=inf), 0.0), (AnnularMirror(focal_length=inf), 0.2)):
        model = build(mirror)
        motions = rigid_modes(model.nodes, np.array([0.0, 0.0, -0.01]))
        gram = motions.T @ (model.mass @ motions)
        total = gram[0, 0]
        axial = total * (0.5**2 + inner**2) / 2
        diametral = axial / 2 + total * 0.02**2 / 12
        np.testing.assert_allclose(np.diag(gram)[3:], [diametral, diametral, axial], rtol=1e-5)
        np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, rtol=0, atol=1e-10)


def test_center_of_mass_of_a_meniscus():
    """The mean of r^2 over a disc is R^2 / 2, so the front lies R^2 / (8 f) above the vertex in the mean."""
    model = circular_mirror()
    vertical = np.zeros(model.order)
    vertical[2::3] = 1.0
    heights = np.repeat(model.nodes[:, 2], 3) * vertical
    center = heights @ (model.mass @ vertical) / (vertical @ (model.mass @ vertical))
    assert center == pytest.approx(0.5**2 / (8 * 1.7) - 0.01, rel=3e-5)


@pytest.mark.parametrize("mirror", DEFAULTS, ids=NAMES)
def test_front_follows_the_parabola(mirror):
    model = build(mirror)
    focal_length = getattr(mirror, "focal_length", 30.0)
    x, y, z = model.nodes[model.surface_nodes].T
    np.testing.assert_allclose(z, (x**2 + y**2) / (4 * focal_length), rtol=0, atol=1e-15)
    assert len(model.surface_nodes) >= 900


@pytest.mark.parametrize("mirror", DEFAULTS, ids=NAMES)
def test_weights_are_shares_of_the_area(mirror):
    model = build(mirror)
    weights, nodes = model.surface_weights, model.nodes[model.surface_nodes]
    assert (weights > 0).all()
    assert weights.sum() == pytest.approx(1.0, abs=1e-13)
    if isinstance(mirror, HexagonalSegment):
        moment = 5 / 12 * mirror.side**2
    else:
        moment = (mirror.diameter**2 + getattr(mirror, "inner_diameter", 0.0) ** 2) / 8
    # Lumping shares out an element's area; it moves second moments by some (size / radius)^2.
    assert weights @ (nodes[:, 0] ** 2 + nodes[:, 1] ** 2) == pytest.approx(moment, rel=0.02)
    np.testing.assert_allclose(weights @ nodes[:, :2], 0, rtol=0, atol=1e-14)


@pytest.mark.parametrize("mirror", DEFAULTS, ids=NAMES)
@pytest.mark.parametrize("layers", [1, 2])
def test_meshes_have_threefold_symmetry(mirror, layers):
    nodes = mirror_mesh(replace(mirror, layers=layers)).nodes
    cosine, sine = np.cos(2 * pi / 3), np.sin(2 * pi / 3)
    turned = nodes @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]).T
    both = np.round(np.stack([nodes, turned]), 9) + 0.0
    first, second = (points[np.lexsort(points.T)] for points in both)
    np.testing.assert_allclose(first, second, rtol=0, atol=2e-9)


@pytest.mark.parametrize("mirror", DEFAULTS, ids=NAMES)
def test_mounts_are_nodes_of_the_rear_face(mirror):
    model = build(mirror)
    x, y, z = model.nodes[model.interfaces].T
    angles = np.radians([0, 120, 240])
    np.testing.assert_allclose(x, mirror.mount_radius * np.cos(angles), rtol=0, atol=1e-15)
    np.testing.assert_allclose(y, mirror.mount_radius * np.sin(angles), rtol=0, atol=1e-15)
    focal_length = getattr(mirror, "focal_length", 30.0)
    np.testing.assert_allclose(z, mirror.mount_radius**2 / (4 * focal_length) - mirror.thickness)


@st.composite
def uneven_angles(draw):
    """Three to five angles, deg, at least 40 apart around the circle."""
    shares = np.array(draw(st.lists(st.floats(0.1, 1.0), min_size=3, max_size=5)))
    gaps = 40 + (360 - 40 * len(shares)) * shares / shares.sum()
    return tuple(float(angle) for angle in draw(st.floats(-720, 720)) + np.cumsum(gaps))


@settings(max_examples=40, deadline=None)
@given(
    uneven_angles(),
    st.floats(0.05, 0.5),
    st.sampled_from([CircularMirror(core=3, rings=4), AnnularMirror(around=18, rings=4)]),
)
def test_mounts_lie_at_any_angle_and_radius(angles, radius, mirror):
    radius = max(radius, getattr(mirror, "inner_diameter", 0.0) / 2)
    mesh = mirror_mesh(replace(mirror, mount_radius=radius, mount_angles=angles))
    x, y, _ = mesh.nodes[mesh.mounts].T
    np.testing.assert_allclose(x, radius * np.cos(np.radians(angles)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(y, radius * np.sin(np.radians(angles)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("mirror", [CircularMirror(core=3, rings=4), AnnularMirror(around=18, rings=4)])
@pytest.mark.parametrize("radius", [0.21, 0.4, 0.49, 0.5])
def test_uneven_mounts_leave_a_sound_mesh(mirror, radius):
    model = build(replace(mirror, mount_radius=radius, mount_angles=(17.0, 95.0, 250.0)))
    assert model.mass.sum() == pytest.approx(build(mirror).mass.sum(), rel=2e-4)


def free_plate_roots(poisson, diameters, circles=2):
    """Squared frequency parameters of a free circular Kirchhoff plate with some nodal diameters.

    The radial moment and the effective shear force of A J_n(k r) + B I_n(k r) vanish at r = 1 (Leissa,
    Vibration of Plates, NASA SP-160, Section 2.1.3).
    """

    def determinant(k):
        columns = []
        for bessel, sign in ((jvp, -1.0), (ivp, 1.0)):
            value, slope, curvature = (k**order * bessel(diameters, k, order) for order in range(3))
            moment = curvature + poisson * (slope - diameters**2 * value)
            shear = sign * k**2 * slope - (1 - poisson) * diameters**2 * (slope - value)
            columns.append((moment, shear))
        (a, c), (b, d) = columns
        return (a * d - b * c) / ivp(diameters, k, 0)

    grid = np.linspace(0.5, 12.0, 300)
    signs = np.sign([determinant(k) for k in grid])
    brackets = np.flatnonzero(signs[:-1] != signs[1:])[:circles]
    return [brentq(determinant, grid[at], grid[at + 1]) ** 2 for at in brackets]


def plate_frequencies(thickness, count, radius=0.5):
    """Hz, of a plate of aluminum; modes with nodal diameters come in pairs."""
    roots = [root for n in range(7) for root in free_plate_roots(0.33, n) for _ in range(2 if n else 1)]
    speed = sqrt(70e9 * thickness**2 / (12 * (1 - 0.33**2) * 2700.0))
    return np.sort(roots)[:count] * speed / (2 * pi * radius**2)


def test_roots_of_the_free_plate_are_the_published_ones():
    """Blevins, Formulas for Natural Frequency and Mode Shape, Table 11-1: nu = 0.3."""
    published = {0: [9.003, 38.44], 1: [20.47], 2: [5.358, 35.26], 3: [12.44], 4: [21.84]}
    for diameters, roots in published.items():
        np.testing.assert_allclose(free_plate_roots(0.3, diameters)[: len(roots)], roots, rtol=5e-4)


def test_thin_flat_disc_has_the_frequencies_of_a_kirchhoff_plate():
    model = circular_mirror(CircularMirror(focal_length=inf, thickness=0.004))
    found = eigenmodes(model, 18)[0][6:]
    np.testing.assert_allclose(found, plate_frequencies(0.004, 12), rtol=5e-3)
    np.testing.assert_allclose(found[:5], plate_frequencies(0.004, 5), rtol=2e-3)


def test_shear_and_rotary_inertia_lower_the_frequencies_of_a_thicker_disc():
    """The higher the mode, the more: 1 % at the ninth."""
    found = eigenmodes(circular_mirror(CircularMirror(focal_length=inf)), 15)[0][6:]
    loss = 1 - found / plate_frequencies(0.02, 9)
    assert ((loss > 1e-3) & (loss < 0.013)).all()
    assert loss[5:].min() > loss[:3].max()


def test_frequencies_of_the_mirrors():
    """Those found with an independent program before this one was written, as far as they were printed."""
    circular = [103.7, 103.7, 240, 240, 295.4, 420, 420, 464, 464, 642]
    annular = [89.1, 89.1, 230.7, 230.7, 289.6, 403.8, 403.8, 415.2, 415.2, 598, 598, 640]
    np.testing.assert_allclose(eigenmodes(circular_mirror(), 16)[0][6:], circular, rtol=6e-4)
    np.testing.assert_allclose(eigenmodes(annular_mirror(), 18)[0][6:], annular, rtol=6e-4)


@pytest.mark.parametrize("mirror", DEFAULTS, ids=NAMES)
def test_symmetry_makes_pairs_of_equal_frequencies(mirror):
    """Two nodal diameters: a pair in every threefold symmetric body."""
    frequencies, modes = eigenmodes(build(mirror), 8)
    assert frequencies[7] == pytest.approx(frequencies[6], rel=1e-9)
    assert abs(modes[:, 6] @ modes[:, 7]) < 0.1 * np.linalg.norm(modes[:, 6]) * np.linalg.norm(modes[:, 7])


def test_defocus_lies_near_300_hz():
    """Störkle 2018, Section 4.4.1: the sensitivity of the defocus peaks around 300 Hz."""
    model = circular_mirror()
    frequencies, modes = eigenmodes(model, 14)
    motion = (model.surface @ modes[:, 6:]).reshape(-1, 3, 8)[:, 2]
    x, y, _ = model.nodes[model.surface_nodes].T
    defocus = 2 * (x**2 + y**2) / 0.25 - 1
    share = np.abs(model.surface_weights * defocus @ motion) / np.sqrt(model.surface_weights @ motion**2)
    assert 290 < frequencies[6 + np.argmax(share)] < 300


def thick_mirror_frequencies(divisions, stiffness_points, mass_points):
    mirror = CircularMirror(thickness=0.1, core=divisions, rings=divisions)
    mesh = mirror_mesh(mirror)
    mass, stiffness = assemble(mesh.nodes, mesh.elements, mirror.material, stiffness_points, mass_points)
    return eigenmodes(replace(circular_mirror(mirror), mass=mass, stiffness=stiffness), 13)[0][6:]


def test_frequencies_converge_with_the_order_of_the_elements():
    """Full integration: from above, and with the fourth power of the elements' size (more than the third)."""
    coarse, medium, fine = (thick_mirror_frequencies(divisions, 3, 3) for divisions in (2, 3, 5))
    assert (medium > fine).all()
    third_power = (2**-3 - 3**-3) / (3**-3 - 5**-3)
    assert ((coarse - medium) / (medium - fine) > third_power).all()


def test_the_default_integration_is_better_than_the_full_one():
    fine = thick_mirror_frequencies(5, 2, 3)
    default, full = (np.abs(thick_mirror_frequencies(2, points, 3) - fine) for points in (2, 3))
    assert (default < 0.8 * full).all()


def test_segment_on_its_supports():
    """No rigid mode; piston near 50 Hz, a little below that of a rigid body; elastic modes far above."""
    free = hexagonal_segment(HexagonalSegment(divisions=4))
    held = on_springs(free, SEGMENT_SUPPORT)
    frequencies, modes = eigenmodes(held, 8)
    assert (frequencies > 1).all()
    assert frequencies[6] > 100
    piston = np.abs((free.surface @ modes[:, :6]).reshape(-1, 3, 6)[:, 2].mean(axis=0))
    found = frequencies[np.argmax(piston)]
    assert found == pytest.approx(sqrt(15e6 / (free.mass.sum() / 3)) / (2 * pi), rel=0.1)
    assert found == pytest.approx(50, abs=3)


CASES = [
    (CircularMirror(thickness=0.0), "the thickness of the CircularMirror is 0.0 m; it must be positive"),
    (CircularMirror(diameter=nan), "the diameter of the CircularMirror is nan m"),
    (CircularMirror(focal_length=np.nan), "the focal_length of the CircularMirror is no number"),
    (CircularMirror(focal_length=-0.1), "-0.1 m, makes its rim steeper .* with a minus sign"),
    (CircularMirror(focal_length=0.12), "0.12 m, makes its rim steeper .* at least 0.125 m"),
    (HexagonalSegment(parent_radius=0.3), "0.15 m, makes its rim steeper"),
    (HexagonalSegment(parent_radius=0.0), "the parent_radius of the HexagonalSegment is 0.0 m"),
    (HexagonalSegment(side=-1.0), "the side of the HexagonalSegment is -1.0 m"),
    (AnnularMirror(inner_diameter=1.0), r"inner diameter of the AnnularMirror, 1.0 m, must be less than"),
    (AnnularMirror(inner_diameter=0.0), "the inner_diameter of the AnnularMirror is 0.0 m"),
    (
        CircularMirror(mount_radius=0.51),
        "the radius 0.51 m lie outside the mirror, which reaches from 0.0",
    ),
    (AnnularMirror(mount_radius=0.1), "at the radius 0.1 m lie outside the mirror, which reaches from 0.2"),
    (HexagonalSegment(mount_radius=0.8), "at the radius 0.8 m lie outside the mirror"),
    (CircularMirror(layers=0), "layers of the CircularMirror is 0; the mesh needs at least 1"),
    (AnnularMirror(around=2), "around of the AnnularMirror is 2; the mesh needs at least 3"),
    (CircularMirror(rings=1), "a mesh with 1 ring cannot have nodes at the mount radius 0.333 m"),
    (CircularMirror(mount_angles=(0.0, 1.0, 200.0)), r"two of the mount angles .* closer than the mesh"),
    (CircularMirror(mount_angles=(0.0, 180.0)), "the 2 interface nodes .* lie on a line"),
    (CircularMirror(mount_angles=()), r"the mount angles of the CircularMirror are \(\); give at least"),
    (CircularMirror(mount_angles=(0.0, nan, 90.0)), "mount angles .* give at least"),
]


@pytest.mark.parametrize(("mirror", "message"), CASES, ids=[message[:40] for _, message in CASES])
def test_impossible_mirrors_are_refused(mirror, message):
    with pytest.raises(UserError, match=message):
        build(mirror)


@pytest.mark.parametrize("stiffness", [(-1.0, 0.0, 0.0), (nan, 0.0, 0.0), (1.0, 1.0)])
def test_impossible_springs_are_refused(stiffness):
    model = hexagonal_segment(HexagonalSegment(divisions=2, mount_radius=0.36))
    with pytest.raises(UserError, match="spring constants"):
        on_springs(model, stiffness)
