import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wavefront_cases import two_of_492

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.derivatives.central import DOFS, Steps
from wavequake.optics.rays.pupils import PupilRays, on_glass, sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import at_field, prepare
from wavequake.optics.segments.sensitivity import sensitivities
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import Surface
from wavequake.optics.wavefronts.sphere_fit import reference_fit

DATA = Path(__file__).parents[1] / "data"
WAVELENGTH = 550e-6
DX, DY, DZ, RX, RY, RZ = range(6)


def reference(name):
    return json.loads((DATA / name).read_text())


def annular_factor(prepared):
    return 1 / np.sqrt(1 + prepared.system.pupil.obscuration**2)


def chief(prepared, los, zernike):
    """The chief ray's image point, from Eq. 3.39 solved for it."""
    tilt = 2 * WAVELENGTH / prepared.numerical_aperture * annular_factor(prepared)
    return los + tilt * zernike[..., 1:3]


@pytest.fixture(scope="module")
def thesis():
    """The monolithic telescope at the reference's nodes: 24 Gauss-Legendre in r^2 by 96 azimuths."""
    system = telescope("tmt-thesis")
    nodes, weights = np.polynomial.legendre.leggauss(24)
    inner, outer = system.annulus.inner, system.annulus.outer
    r = np.sqrt(inner**2 + (outer**2 - inner**2) * (nodes + 1) / 2)
    angle = 2 * np.pi * np.arange(96) / 96
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    return prepare(
        system, PupilRays(x, y, np.repeat(weights, 96), np.zeros(len(x), dtype=int)), WAVELENGTH, 45
    )


@pytest.fixture(scope="module")
def tmt18():
    """18 hexagons at the reference's 2000 sunflower rays."""
    system = telescope("tmt-18")
    rays = on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 2000))
    return prepare(system, rays, WAVELENGTH, 45)


@pytest.fixture(scope="module")
def of_thesis(thesis):
    return sensitivities(thesis, NUMPY)


@pytest.fixture(scope="module")
def of_tmt18(tmt18):
    return sensitivities(tmt18, NUMPY)


def test_m2_against_an_independent_trace(thesis, of_thesis):
    m2 = of_thesis.surfaces
    assert m2.elements == ("M2", "M3", "image")
    assert m2.dofs == DOFS
    for dof, name, per_unit in ((RX, "alpha", 1.0), (DZ, "dz", 1e3)):
        expected = reference("tmt_optics.json")["m2_rigid_per_m_or_rad"][name]
        c = np.array(expected["c_noll_annular_waves"])
        zernike, los = m2.zernike[0, dof] * per_unit, m2.los[0, dof] * per_unit
        np.testing.assert_allclose(zernike, c, rtol=0, atol=1e-6 * np.abs(c).max())
        for values, key in (
            (chief(thesis, los, zernike), "chief"),
            (m2.centroid[0, dof] * per_unit, "centroid"),
            (los, "LOS_339_annular_over_sqrt1pe2"),
        ):
            np.testing.assert_allclose(1e-3 * values, expected[key], rtol=1e-6, atol=2e-6, err_msg=key)


def test_the_printed_tilt_matrix_of_m2(of_thesis):
    """Störkle 2018, Eq. 4.24, is Eq. 3.39 with the annular factor; the chief ray (87188) or centroid (84609)
    is not. The image's y axis has the other sign there."""
    printed = np.array([[0.0, -85460.0], [85460.0, 0.0]])
    ours = of_thesis.surfaces.los[0, [RX, RY]].T
    np.testing.assert_allclose(np.abs(ours), np.abs(printed), rtol=0, atol=0.5)
    assert ours[0, 1] * ours[1, 0] < 0


def test_m2_about_its_center_of_curvature_leaves_the_chief_ray(thesis, of_thesis):
    """R rx about the center of curvature at (0, 0, R) is rx about the vertex and a shift by R along y."""
    m2, radius = of_thesis.surfaces, thesis.system.after_primary[0].shape.radius
    for turn, shift in (
        (m2_column(m2, RX), radius * m2_column(m2, DY)),
        (m2_column(m2, RY), -radius * m2_column(m2, DX)),
    ):
        los, zernike = (turn + shift)[:2], (turn + shift)[2:]
        assert np.abs(chief(thesis, los, zernike)).max() < 2e-2  # of 87188 mm/rad
        assert np.abs(los).max() > 1e3  # while coma moves the line of sight


def m2_column(matrix, dof):
    return np.concatenate([matrix.los[0, dof], matrix.zernike[0, dof]])


def test_the_image_plane_and_the_flat_move_as_geometry_says(of_thesis):
    """On axis the beam meets the detector along its normal, and the 45 degree flat shifts it."""
    los = dict(zip(of_thesis.surfaces.elements, of_thesis.surfaces.los, strict=True))
    np.testing.assert_allclose(los["image"][:3], [[-1, 0], [0, -1], [0, 0]], rtol=0, atol=1e-6)
    # A flat that turns by a about the y axis turns the beam by 2 a: 20 m to the image give 40 m/rad.
    np.testing.assert_allclose(los["M3"][3:], [[0, np.sqrt(8) * 1e4], [-4e4, 0], [0, 0]], rtol=0, atol=1e-2)
    np.testing.assert_allclose(los["M3"][DY], 0, rtol=0, atol=1e-6)
    assert (
        np.abs(of_thesis.surfaces.zernike[0, RZ]).max() < 1e-6 * np.abs(of_thesis.surfaces.zernike[0]).max()
    )


def global_piston(prepared, values):
    """Columns for a shift along the telescope's z axis from those in the segments' own axes."""
    along_z = -prepared.system.segments.axes[:, 2, :]  # local components of the unit vector along the light
    return np.einsum("sd,sd...->s...", along_z, values[:, :3])


def test_pistons_of_18_segments_against_an_independent_trace(tmt18, of_tmt18):
    data = reference("tmt18_segments.json")
    expected = {key: np.array(values) for key, values in data["piston_z"].items()}
    zernike = 1e3 * global_piston(tmt18, of_tmt18.segments.zernike)
    los = 1e3 * global_piston(tmt18, of_tmt18.segments.los)
    # The reference prints Eq. 3.39 without the annular factor and scales the NA of 15 m.
    printed = chief(tmt18, los, zernike) - 2 * WAVELENGTH / data["numerical_aperture"] * zernike[:, 1:3]
    centroid = 1e3 * global_piston(tmt18, of_tmt18.segments.centroid)
    for values, key in ((zernike, "zernike"), (1e-3 * printed, "los"), (1e-3 * centroid, "centroid")):
        np.testing.assert_allclose(
            values, expected[key], rtol=0, atol=1e-6 * np.abs(expected[key]).max(), err_msg=key
        )


def test_two_of_492_segments_against_an_independent_trace():
    """The reference moves along and turns about the telescope's axes, so columns are added up.

    The local frame is a reflection of the optics frame, so that axes of rotation change their sign, too.
    """
    names = ["A1", "B10"]
    prepared = two_of_492(names)
    matrix = sensitivities(prepared, NUMPY).segments
    assert matrix.agrees
    share = np.bincount(prepared.rays.segment) / len(prepared.rays.segment)
    flip = np.diag([1.0, 1.0, -1.0])
    for k, name in enumerate(names):
        expected = reference("tmt492_segments.json")["segments"][name]
        to_optics = flip @ prepared.system.segments.axes[k]
        shifts = to_optics @ matrix.centroid[k, :3]
        turns = -to_optics @ matrix.centroid[k, 3:]
        for centroid, dof in (
            (shifts[2], "piston_z"),
            (1e-3 * turns[0], "rot_x"),
            (1e-3 * turns[1], "rot_y"),
        ):
            spot = expected[dof]["spot_shift_of_segment_m_per_unit"]
            np.testing.assert_allclose(centroid / share[k], spot, rtol=1e-6, atol=1e-5, err_msg=name + dof)


def carried(system, primary, surfaces, values):
    """The sum of columns (6, ...) by which M1 and all that follows move as one body about M1's vertex."""
    total = getattr(primary, values)[0].copy()
    for surface, own in zip(system.after_primary, getattr(surfaces, values), strict=True):
        columns = np.kron(np.eye(2), surface.rotation) @ own  # along and about the axes of M1
        total += columns
        total[3:] += np.cross(np.eye(3), surface.position) @ columns[:3]
    return total


@pytest.mark.parametrize("name", ["thesis", "tmt18"])
def test_a_telescope_that_moves_as_a_whole_only_looks_elsewhere(name, request):
    """Shifts change nothing; a turn by a about x (y) is light that comes from a (-a) along y (x).

    Reference spheres are those that fit best: the virtual chief ray follows the field, but not M1. Piston
    (the first column of 45) is the whole telescope's way along the light.
    """
    prepared = request.getfixturevalue(name)
    prepared = replace(prepared, sphere=reference_fit(prepared))
    found = sensitivities(prepared, NUMPY)
    states, step = rest_states(prepared.system, TILE), 1e-6
    states.line_of_sight[:4] = step * np.array([[0, 1], [0, -1], [-1, 0], [1, 0]])
    wavefront = measure(prepared, states, NUMPY)
    for values, part in (("centroid", slice(None)), ("los", slice(None)), ("zernike", slice(1, None))):
        actual = getattr(wavefront, values)
        expected = np.zeros((6, actual.shape[1]))
        expected[3:5] = (actual[[0, 2]] - actual[[1, 3]]) / (2 * step)
        total = carried(prepared.system, found.primary, found.surfaces, values)
        for motions in (slice(0, 3), slice(3, 6)):
            size = np.abs(getattr(found.primary, values)[0, motions, part]).max()
            error = np.abs(total - expected)[motions, part].max()
            assert error < 1e-6 * size, (values, motions, error / size)
    assert found.primary.agrees


def test_the_m1_of_one_piece_moves_as_its_only_segment(of_thesis):
    """Its center is the vertex; there z is to the sky, which turns the sense of rx and ry, too."""
    one, segment = of_thesis.primary, of_thesis.segments
    assert one.elements == ("M1",)
    sign = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
    for values in ("zernike", "los", "centroid"):
        actual, expected = getattr(one, values)[0], sign[:, None] * getattr(segment, values)[0]
        scale = np.repeat([np.abs(expected[:3]).max(), np.abs(expected[3:]).max()], 3)[:, None]
        np.testing.assert_allclose(actual / scale, expected / scale, rtol=0, atol=1e-9, err_msg=values)
    # A mirror that turns by a turns the image by 2 a f, less what it is shifted on M2.
    assert abs(one.los[0, RX, 1]) == pytest.approx(882085.0, abs=1.0)
    assert one.los[0, RX, 1] * of_thesis.surfaces.los[0, RX, 1] < 0  # M2 turns the image the other way


def test_m1_and_the_surfaces_after_it_are_one_matrix(of_thesis):
    everything = of_thesis.all_surfaces
    assert everything.elements == ("M1", "M2", "M3", "image")
    np.testing.assert_array_equal(everything.los[0], of_thesis.primary.los[0])
    np.testing.assert_array_equal(everything.disagreement[1:], of_thesis.surfaces.disagreement)


def test_small_motions_are_the_matrix_product_to_second_order(tmt18, of_tmt18):
    rng = np.random.default_rng(41)
    segments = rng.normal(size=(18, 6)) * np.repeat([1e-4, 1e-7], 3)
    surfaces = rng.normal(size=(3, 6)) * np.repeat([1e-2, 1e-6], 3)
    states = rest_states(tmt18.system, TILE)
    scale = np.array([0.0, 1.0, 0.5])
    states.segment_motion[:3] = scale[:, None, None] * segments
    states.surface_motion[:3, 2:] = scale[:, None, None] * surfaces
    wavefront = measure(tmt18, states, NUMPY)
    for name in ("zernike", "los", "centroid"):
        linear = np.einsum("ed,edk->k", segments, getattr(of_tmt18.segments, name))
        linear += np.einsum("ed,edk->k", surfaces, getattr(of_tmt18.surfaces, name))
        actual = getattr(wavefront, name)
        error = [np.abs(actual[i] - actual[0] - scale[i] * linear).max() for i in (1, 2)]
        size = np.abs(linear).max()
        assert error[0] < 1e-3 * size, name
        assert error[1] < 0.3 * error[0] + 1e-9 * size, name  # a quarter, as a second-order term is


def test_two_steps_agree(of_thesis, of_tmt18):
    for matrix in (of_thesis.surfaces, of_thesis.segments, of_tmt18.surfaces, of_tmt18.segments):
        assert matrix.agrees
        assert matrix.worst[2] == matrix.disagreement.max() < 1e-6
        assert matrix.worst[2] > 0


def test_nothing_but_rounding_is_no_disagreement():
    """Without a second mirror no turn of a surface changes anything: zeros agree, and so do the segments."""
    cassegrain = telescope("tmt-thesis")
    image = Surface("image", position=np.array([0.0, 0.0, -3e4]))
    system = replace(cassegrain, surfaces=(*cassegrain.surfaces[:2], image))
    prepared = prepare(
        system, on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 300)), WAVELENGTH, 11
    )
    found = sensitivities(prepared, NUMPY)
    assert np.abs(found.surfaces.los[0, RX:]).max() < 1e-5  # mm/rad
    assert found.surfaces.agrees
    assert found.segments.agrees
    np.testing.assert_allclose(found.surfaces.los[0, :2], -np.eye(2), rtol=0, atol=1e-6)


def test_too_large_a_step_is_flagged(tmt18):
    """Tilted by milliradians, segments act nonlinearly."""
    matrix = sensitivities(tmt18, NUMPY, steps=Steps(rotation=3e-3)).segments
    assert not matrix.agrees
    element, dof, size = matrix.worst
    assert dof in ("rx", "ry", "rz")
    assert element in tmt18.system.segments.names
    assert size > 1e-5


def test_a_motion_that_loses_rays_is_flagged():
    system = telescope("tmt-18")
    segments = on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 500))
    prepared = prepare(system, segments, WAVELENGTH, 11)
    matrix = sensitivities(prepared, NUMPY, steps=Steps(translation=50.0)).segments
    gone = np.isinf(matrix.disagreement)
    assert gone[:, [DX, DY]].any()
    assert not gone[:, RX:].any()
    assert not matrix.agrees
    assert np.isinf(matrix.worst[2])
    assert np.isfinite(matrix.zernike).all()


def test_figures_act_as_the_rigid_motions_that_they_equal():
    """Piston is dz; tilts turn about the segment's axes, whose unit is the circumscribed radius."""
    system = telescope("tmt-18")
    rays = on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 1000))
    of_both = sensitivities(prepare(system, rays, WAVELENGTH, 22, figure_terms=4), NUMPY)
    segments, figures = of_both.segments, of_both.figures
    assert figures.dofs == ("Z1", "Z2", "Z3", "Z4")
    assert figures.agrees
    radius = np.linalg.norm(system.segments.corners - system.segments.centers[:, None, :2], axis=2).max(
        axis=1
    )
    for term, dof, factor in ((0, DZ, np.ones(18)), (1, RY, -2 / radius), (2, RX, 2 / radius)):
        rigid = factor[:, None] * segments.zernike[:, dof]
        error = np.abs(figures.zernike[:, term] - rigid).max()
        assert error < 0.05 * np.abs(rigid).max(), term  # figures live in projected coordinates
    assert sensitivities(prepare(system, rays, WAVELENGTH, 22), NUMPY).figures is None


def test_the_raw_rms_is_that_of_the_zernikes_where_they_are_orthonormal(of_thesis):
    """Gaussian nodes integrate products of polynomials exactly, and motions of M2 give low orders."""
    m2, scale = of_thesis.surfaces, np.repeat([1e2, 1e5], 3)
    expected = np.linalg.norm(m2.zernike[0, :, 1:], axis=1)
    assert (expected > 0.1 * scale)[[DX, DY, RX, RY]].all()
    np.testing.assert_allclose(m2.rms_raw[0] / scale, expected / scale, rtol=0, atol=1e-6)


def test_the_raw_rms_is_that_of_the_opd_on_the_segment(tmt18, of_tmt18):
    """A segment that shortens the path of its share p by 2 cos: rms 2 cos sqrt(p (1 - p))."""
    segment = tmt18.rays.segment
    share = np.bincount(segment, tmt18.weight, 18)
    expected = 2 * np.sqrt(share * (1 - share)) / WAVELENGTH
    np.testing.assert_allclose(of_tmt18.segments.rms_raw[:, DZ], expected, rtol=0.02)


def test_it_is_about_the_field_point(thesis):
    field = np.array([2e-3, 0.0])
    here = sensitivities(at_field(thesis, field), NUMPY).surfaces
    states = rest_states(thesis.system, TILE)
    states.line_of_sight[:] = field
    states.surface_motion[0, 2, DX], states.surface_motion[1, 2, DX] = 1e-3, -1e-3
    wavefront = measure(thesis, states, NUMPY)
    expected = (wavefront.zernike[0] - wavefront.zernike[1]) / 2e-3
    np.testing.assert_allclose(here.zernike[0, DX], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert here.agrees


@pytest.mark.parametrize("name", ["translation", "rotation", "figure"])
@pytest.mark.parametrize("value", [0.0, -1e-6, np.nan, np.inf])
def test_a_step_must_be_positive(tmt18, name, value):
    with pytest.raises(UserError, match=f"step of a {name}"):
        sensitivities(tmt18, NUMPY, steps=replace(Steps(), **{name: value}))


def test_a_field_point_that_no_ray_leaves_is_refused(tmt18):
    with pytest.raises(UserError, match="field point"):
        sensitivities(at_field(tmt18, np.array([1.0, 0.0])), NUMPY)
