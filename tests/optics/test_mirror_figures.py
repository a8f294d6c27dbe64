"""Figures and edges of the mirrors after M1, against a trace of two mirrors that shares nothing with them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.status import VIGNETTED, lost_at
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.sensitivity import sensitivities
from wavequake.optics.segments.telescope import footprints, with_figures
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states

WAVELENGTH = 550e-6
M1 = -1 / 60e3, -1.0009535
M2 = -1 / 6227.68, -1.31822813
TERMS, FIGURE = 45, 15


def sag_and_normal(x, y, curvature, conic):
    root = np.sqrt(1 - (1 + conic) * curvature**2 * (x**2 + y**2))
    normal = np.stack([-curvature * x / root, -curvature * y / root, np.ones_like(x)])
    return curvature * (x**2 + y**2) / (1 + root), normal / np.linalg.norm(normal, axis=0)


def meet(position, direction, vertex, mirror):
    """Secant steps to the mirror from a plane near it, then the reflection: hit and new direction."""

    def height(step):
        hit = position + step * direction
        return hit[2] - vertex - sag_and_normal(hit[0], hit[1], *mirror)[0]

    before = (vertex - position[2]) / direction[2]
    step = before + 1.0
    for _ in range(30):
        slope = (height(step) - height(before)) / (step - before + (step == before))
        change = np.where(slope == 0, 0.0, height(step) / np.where(slope == 0, 1.0, slope))
        before, step = step, step - change
    hit = position + step * direction
    normal = sag_and_normal(hit[0], hit[1], *mirror)[1]
    return hit, direction - 2 * np.sum(direction * normal, axis=0) * normal


def at_m2(x, y, field=0.0):
    """Where rays from (x, y) in the stop's plane meet M2, and their directions before and after it."""
    incoming = np.array([np.sin(field), 0.0, np.cos(field)])[:, None] * np.ones_like(x)
    hit, toward = meet(np.stack([x, y, np.full_like(x, -1874.9721)]), incoming, 0.0, M1)
    on_m2, outgoing = meet(hit, toward, -27093.75, M2)
    return on_m2, toward, outgoing


def test_the_conic_of_m2_is_misprinted(monkeypatch):
    """Störkle 2018, Table 4.2: only with a minus do rays meet the axis at one place."""
    x = np.linspace(1600.0, 15000.0, 8)
    for sign, spread in ((1, (0, 0.03)), (-1, (1e5, np.inf))):
        monkeypatch.setitem(globals(), "M2", (M2[0], sign * abs(M2[1]) * -1))
        hit, _, outgoing = at_m2(x, 0 * x)
        focus = hit[2] - hit[0] * outgoing[2] / outgoing[0]
        assert spread[0] <= np.ptp(focus) <= spread[1]


def test_an_annular_pupil_has_a_distinct_first_ring():
    """Störkle 2018, Fig. 4.39: 4.3 % of the peak for the pupil of 18 segments, 1.75 % for a full circle."""
    at = np.pi * np.linspace(1.2, 2.2, 2001)  # lambda / D
    for inner, height in ((0.27735, 0.0430), (0.0, 0.01750)):
        field = 2 * (j1(at) - inner * j1(inner * at)) / (at * (1 - inner**2))
        assert (field**2).max() == pytest.approx(height, abs=1e-4)


@pytest.fixture(scope="module")
def thesis():
    system = telescope("tmt-thesis")
    inner, outer = system.annulus.inner, system.annulus.outer
    nodes, weights = np.polynomial.legendre.leggauss(16)
    r, angle = np.sqrt(inner**2 + (outer**2 - inner**2) * (nodes + 1) / 2), 2 * np.pi * np.arange(64) / 64
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    rays = PupilRays(x, y, np.repeat(weights, 64), np.zeros(len(x), dtype=int))
    return prepare(system, rays, WAVELENGTH, TERMS, mirror_terms=FIGURE)


@pytest.fixture(scope="module")
def found(thesis):
    return sensitivities(thesis, NUMPY)


def test_the_footprint_is_where_the_marginal_ray_arrives(thesis):
    on_m2, _, _ = at_m2(np.array([15000.0]), np.array([0.0]))
    radii = footprints(thesis.system)
    assert radii[0] == pytest.approx(on_m2[0, 0].__abs__(), rel=1e-12)
    assert radii[0] == pytest.approx(1459.6, abs=0.1)
    # On the fold the beam is an ellipse; its cone of f/15 ends 20 m behind it.
    assert radii[1] == pytest.approx(
        20000.0 * np.tan(np.arcsin(1 / 30)) * np.sqrt(2) / (1 - 1 / 30), rel=2e-3
    )


def test_figures_of_m2_against_the_change_of_paths_at_the_undisturbed_hits(thesis, found):
    """To first order a mirror that moves by d changes a path by (incoming - outgoing direction) d.

    Störkle 2018, Eq. 4.26. A figure's slope at the vertex also moves the chief ray, and with it tilt.
    """
    matrix, rays = found.mirrors, thesis.rays
    assert matrix.elements == ("M2", "M3")
    assert found.mirrors.agrees, found.mirrors.worst
    on_m2, toward, outgoing = at_m2(rays.x, rays.y)
    radius = footprints(thesis.system)[0]
    figures = annular_zernike(on_m2[0] / radius, on_m2[1] / radius, FIGURE, 0.0)
    waves = (outgoing - toward)[2][:, None] * figures / WAVELENGTH
    outer = thesis.system.annulus.outer
    basis = annular_zernike(rays.x / outer, rays.y / outer, TERMS, thesis.system.annulus.inner / outer)
    root = np.sqrt(thesis.weight)[:, None]
    expected = np.linalg.lstsq(root * basis, root * waves, rcond=None)[0].T
    np.testing.assert_allclose(
        matrix.zernike[0][:, 3:], expected[:, 3:], rtol=0, atol=1e-5 * np.abs(expected).max()
    )
    diagonal = np.diag(matrix.zernike[0][:, :FIGURE])[3:] * WAVELENGTH
    assert ((diagonal > 1.89) & (diagonal < 1.95)).all()  # 2 for normal incidence


def test_a_constant_figure_is_a_shift_along_the_axis(found):
    m2 = found.surfaces.elements.index("M2")
    np.testing.assert_allclose(
        found.mirrors.zernike[0, 0], found.surfaces.zernike[m2, 2], rtol=1e-6, atol=5e-4
    )
    np.testing.assert_allclose(found.mirrors.los[0, 0], found.surfaces.los[m2, 2], rtol=0, atol=1e-5)


def test_figures_that_do_not_fit_are_refused(thesis):
    states = rest_states(with_figures(thesis.system, 0, 4), TILE)
    said = r"mirrors after M1 have the shapes \[\(16, 4\), \(16, 4\)\], each must be \(16, 15\)"
    with pytest.raises(UserError, match=said):
        trace_states(thesis, states, NUMPY)


def test_a_figure_that_is_no_number_loses_the_rays(thesis):
    states = rest_states(thesis.system, TILE)
    states.deformations[2][2, 3] = np.nan
    wavefront = analyse(thesis, trace_states(thesis, states, NUMPY), chief_rays(thesis, states))
    assert wavefront.lost.tolist() == [len(thesis.rays) if lane == 2 else 0 for lane in range(TILE)]


@pytest.mark.parametrize("arcmin", [0.0, 5.0, 10.0, 15.0])
def test_m2_vignettes_what_misses_its_glass(thesis, arcmin):
    """Semi-diameters of Table 4.2; light from beside the axis moves across M2 and, farther, across M3."""
    field = np.deg2rad(arcmin / 60)
    states = rest_states(thesis.system, TILE)
    states.line_of_sight[:, 0] = field
    traced = trace_states(thesis, states, NUMPY)
    wavefront = analyse(thesis, traced, chief_rays(thesis, states))
    on_m2, _, outgoing = at_m2(thesis.rays.x, thesis.rays.y, field)
    normal, vertex = np.array([1, 0, 1]) / np.sqrt(2), np.array([0, 0, -3500.0])[:, None]
    on_m3 = on_m2 + (normal @ (vertex - on_m2)) / (normal @ outgoing) * outgoing
    beside_m2 = np.hypot(on_m2[0], on_m2[1]) > 1512.2
    beside_m3 = (np.linalg.norm(on_m3 - vertex, axis=0) > 1753.95) & ~beside_m2
    assert bool(beside_m2.any()) == bool(beside_m3.any()) == (arcmin >= 10.0)
    np.testing.assert_array_equal(
        traced.status[0, :, 0], lost_at(VIGNETTED, 0) * beside_m2 + lost_at(VIGNETTED, 1) * beside_m3
    )
    assert (wavefront.vignetted == np.count_nonzero(beside_m2 | beside_m3)).all()
    assert (wavefront.lost == wavefront.vignetted).all()
    # At 15 arcmin what is left of the pupil does not determine the coefficients any more.
    assert np.isfinite(wavefront.zernike).all() == (arcmin < 15.0)


def test_rays_that_a_gap_or_the_image_loses_are_not_vignetted(thesis):
    """M2 aside by 200 mm stops some rays, M2 nowhere all, M1 or the image nowhere loses them otherwise."""
    states = rest_states(thesis.system, TILE)
    states.surface_motion[3, 2, 0] = 200.0
    states.surface_motion[5, 2, 0] = np.nan
    states.surface_motion[7, 4, 0] = np.nan
    states.segment_motion[9, 0, 2] = np.nan
    wavefront = analyse(thesis, trace_states(thesis, states, NUMPY), chief_rays(thesis, states))
    assert 0 < wavefront.vignetted[3] == wavefront.lost[3] < len(thesis.rays)
    assert wavefront.vignetted[[5, 7, 9]].tolist() == [len(thesis.rays), 0, 0]
    assert (wavefront.lost[[5, 7, 9]] == len(thesis.rays)).all()


def test_mirrors_without_edges_vignette_nothing(thesis):
    system = thesis.system
    endless = tuple(replace(surface, opening=None) for surface in system.after_primary)
    bare = prepare(replace(system, surfaces=(*system.surfaces[:2], *endless)), thesis.rays, WAVELENGTH, TERMS)
    states = rest_states(bare.system, TILE)
    states.line_of_sight[:, 0] = np.deg2rad(15 / 60)
    assert (trace_states(bare, states, NUMPY).status == 0).all()


@pytest.mark.parametrize("device", list_devices(), ids=lambda device: device.kind)
def test_more_terms_are_traced_by_recurrences_to_the_same_light(thesis, device):
    """231 terms are monomials and 240 recurrences; without the last nine both are one figure."""
    random = np.random.default_rng(5)
    figure = 2e-5 * random.normal(size=(TILE, 1, 231)) / (1.0 + np.arange(231)) ** 0.5
    mirrors = 2e-5 * random.normal(size=(TILE, 2, 231)) / (1.0 + np.arange(231)) ** 0.5
    opd = []
    for terms in (231, 240):
        prepared = prepare(thesis.system, thesis.rays, WAVELENGTH, 3, figure_terms=terms, mirror_terms=terms)
        assert (prepared.train.figure_basis == "monomial") is (terms == 231)
        assert prepared.train.mirror_basis == prepared.train.figure_basis
        states = rest_states(prepared.system, TILE)
        states.segment_figure[..., :231] = figure
        for form, given in zip(states.deformations[2:4], np.swapaxes(mirrors, 0, 1), strict=True):
            form[:, :231] = given
        traced = trace_states(prepared, states, device)
        assert (traced.status == 0).all()
        opd.append(traced.opd)
    assert np.ptp(opd[0]) > 2e-4  # mm
    np.testing.assert_allclose(opd[1], opd[0], rtol=0, atol=2e-10)
