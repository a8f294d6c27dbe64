"""Aspheres behind a segmented M1: against conics that they equal, and the sequential tracer."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device, list_devices
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.telescope import first_order, footprints
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.shapes.shapes import Conic, EvenAsphere
from wavequake.optics.systems.kinematics import rest_states

WAVELENGTH = 550e-6
NUMPY = choose_device("numpy")
DEVICES = [device.name for device in list_devices()]
# Some 6 and 4 um at the rim of M2, which is 1.5 m wide in radius.
EVEN = (0.0, 1.2e-15, -3e-22, 5e-29)


def tmt18(even=(), radius=None, conic=None):
    system = telescope("tmt-18", gap=20.0)
    m2 = system.after_primary[0]
    numbers = m2.shape.radius if radius is None else radius, m2.shape.conic if conic is None else conic
    shape = EvenAsphere(*numbers, even) if even else Conic(*numbers)
    return replace(
        system, surfaces=(*system.surfaces[:2], replace(m2, shape=shape), *system.after_primary[1:])
    )


def prepared_of(system, **terms):
    return prepare(system, segment_rays(system.segments, 3), WAVELENGTH, 15, **terms)


def moved(prepared, mirror_terms=0):
    """Rest, a field point, and motions of segments, M2 and the image."""
    system = prepared.system
    states = rest_states(system, 16)
    random = np.random.default_rng(5)
    states.segment_motion[3:] = random.normal(size=states.segment_motion[3:].shape) * 1e-5
    states.surface_motion[3:, 2] = random.normal(size=(13, 6)) * [0.1, 0.1, 0.1, 1e-5, 1e-5, 1e-5]
    states.line_of_sight[1:] = [2e-4, -1e-4]
    if mirror_terms:
        for figure in states.deformations[2:4]:
            figure[5:, 3:] = 1e-4 * random.normal(size=(11, mirror_terms - 3))
    return states


@pytest.mark.parametrize("device", DEVICES)
def test_a_plane_with_a_square_term_is_a_paraboloid(device):
    conic = tmt18(conic=-1.0)
    radius = conic.after_primary[0].shape.radius
    even = tmt18(radius=np.inf, conic=0.0, even=(0.5 / radius,))
    for name, value in vars(first_order(conic)).items():
        assert vars(first_order(even))[name] == pytest.approx(value, rel=1e-11, abs=1e-7)
    np.testing.assert_allclose(footprints(even), footprints(conic), rtol=1e-12)
    both = [prepared_of(system) for system in (conic, even)]
    one, other = (trace_states(each, moved(each), choose_device(device)) for each in both)
    for name in ("opd", "x", "y"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=0.0, atol=2e-9)
    slopes = [slope_fit(each).matrix for each in both]
    np.testing.assert_allclose(slopes[1], slopes[0], atol=1e-7 * np.abs(slopes[0]).max())


@pytest.mark.parametrize("device", DEVICES)
def test_the_sequential_tracer_agrees(device):
    system = tmt18(even=EVEN)
    prepared = prepared_of(system)
    states = rest_states(system, 16)
    states.line_of_sight[:] = [2e-4, -1e-4]
    ours = trace_states(prepared, states, choose_device(device))
    x, y = prepared.rays.x, prepared.rays.y
    direction = np.array([np.tan(2e-4), np.tan(-1e-4), 1.0])
    direction /= np.linalg.norm(direction)
    position = np.stack([x, y, np.full_like(x, system.stop_z)])
    rays = Rays(position, np.tile(direction[:, None], (1, len(x))), direction @ position)
    parent = parent_system(system)
    parent = replace(parent, surfaces=tuple(replace(one, opening=None) for one in parent.surfaces))
    theirs = trace_sequence_numpy(pack(parent, WAVELENGTH), rays, moving(parent, rest_states(parent)))
    assert (theirs.status == 0).all()
    np.testing.assert_allclose(np.asarray(ours.x)[0, :, 0], theirs.x[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(np.asarray(ours.y)[0, :, 0], theirs.y[0], rtol=0.0, atol=1e-9)
    # The asphere is there: without it the wavefront is another.
    plain = prepared_of(tmt18())
    change = np.asarray(ours.opd) - np.asarray(trace_states(plain, states, NUMPY).opd)
    assert 1e-3 < np.std(change[0, :, 0]) < 0.1


@pytest.mark.parametrize("device", [name for name in DEVICES if name != "numpy"])
def test_devices_agree_where_mirrors_move_and_deform(device):
    prepared = prepared_of(tmt18(even=EVEN), mirror_terms=11)
    states = moved(prepared, 11)
    here, there = (trace_states(prepared, states, choose_device(name)) for name in ("numpy", device))
    np.testing.assert_allclose(there.opd, here.opd, rtol=0.0, atol=2e-9)
    assert np.isfinite(analyse(prepared, here, chief_rays(prepared, states)).zernike).all()


def test_a_figure_adds_to_an_asphere():
    """Spherical aberration as a figure of M2 takes away what the fourth power adds."""
    bare, even = (prepared_of(tmt18(**one), mirror_terms=11) for one in ({}, {"even": (0.0, 1.2e-16)}))
    states = rest_states(even.system, 16)
    reach = footprints(even.system)[0]
    height = -1.2e-16 * reach**4
    # rho^4 = 1/3 + (j = 4) / (2 sqrt 3) + (j = 11) / (6 sqrt 5), Noll.
    parts = {0: 1.0 / 3.0, 3: 1.0 / (2.0 * np.sqrt(3.0)), 10: 1.0 / (6.0 * np.sqrt(5.0))}
    for term, share in parts.items():
        states.deformations[2][:, term] = height * share
    found = trace_states(even, states, NUMPY)
    expected = trace_states(bare, rest_states(bare.system, 16), NUMPY)
    for name in ("x", "y", "opd"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0.0, atol=2e-9)


def test_figures_that_are_no_sums_of_powers_do_not_go_with_aspheres():
    with pytest.raises(UserError, match="have 231 Zernike terms at most where one of them is an asphere"):
        prepared_of(tmt18(even=EVEN), mirror_terms=232)
