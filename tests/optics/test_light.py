"""One door for the light of any system: packing chooses the kernel, and both kernels agree."""

from dataclasses import replace

import numpy as np
import pytest

import wavequake as wq
from wavequake import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics import light
from wavequake.optics.rays.packing import pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.telescope import with_figures
from wavequake.optics.shapes.forms.biconic import Biconic
from wavequake.optics.systems.system import with_surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

NUMBERS = ("zernike", "rms_raw", "rms_flat", "pv", "chief", "los", "centroid", "spot_rms", "strehl")


@pytest.fixture(scope="module")
def telescope():
    """The 18 hexagons with gaps, in light from beside the axis."""
    return replace(wq.telescope("tmt-18", gap=5.0), fields=np.array([[1e-4, -2e-4]]))


@pytest.fixture(scope="module")
def moved(telescope):
    """Segments, M2, M3, the image and the light, all at once; at rest in the first instant."""
    random, states = np.random.default_rng(1), wq.rest_states(telescope, 3)
    states.segment_motion[1:] = random.normal(size=(2, 18, 6)) * [1e-3, 1e-3, 1e-4, 1e-7, 1e-7, 1e-7]
    states.surface_motion[1:, 2:] = random.normal(size=(2, 3, 6)) * np.repeat([1e-2, 1e-6], 3)
    states.line_of_sight[2] = 1e-6, 2e-6
    return states


def traced(system, states, monkeypatch):
    """Wavefronts, and by which kernel."""
    used = []
    for name in ("_by_segments", "_in_sequence"):
        monkeypatch.setattr(light, name, spied(getattr(light, name), name, used))
    return wq.trace(system, states, rays=100, device="numpy"), used


def spied(function, name, used):
    def call(*arguments):
        used.append(name)
        return function(*arguments)

    return call


def agree(one, other, names=NUMBERS):
    for name in names:
        values = getattr(one, name)
        assert values.shape[0] == 3
        np.testing.assert_allclose(values, getattr(other, name), rtol=0, atol=1e-6, err_msg=name)
    assert np.ptp(one.rms_raw) > 0.1  # waves: something happens


def biconic(surface):
    """The same conic in another form, which the kernel for segments does not know."""
    shape = surface.shape
    return replace(surface, shape=Biconic(shape.radius, shape.conic, shape.radius, shape.conic))


def test_the_kernel_for_segments_is_chosen_where_it_can_express_the_system(telescope, moved, monkeypatch):
    by_segments, used = traced(telescope, moved, monkeypatch)
    assert used == ["_by_segments"]
    other, used = traced(with_surface(telescope, 2, biconic(telescope.surfaces[2])), moved, monkeypatch)
    assert used == ["_in_sequence"]
    agree(by_segments, other)


def test_m1_that_moves_as_a_whole_is_all_its_segments(telescope, moved, monkeypatch):
    """A shift of M1 along the axis, and the same of every segment along its own axes.

    The chief ray follows M1, but not its segments: piston and tilt are about other spheres.
    """
    whole = replace(
        moved, surface_motion=moved.surface_motion.copy(), segment_motion=0 * moved.segment_motion
    )
    whole.surface_motion[1:, 1, 2] = 1e-4
    each = replace(moved, segment_motion=0 * moved.segment_motion)
    each.segment_motion[1:, :, :3] = -1e-4 * telescope.segments.axes[:, 2]
    one, used = traced(telescope, whole, monkeypatch)
    assert used == ["_in_sequence"]
    other, used = traced(telescope, each, monkeypatch)
    assert used == ["_by_segments"]
    agree(one, other, ("rms_flat", "pv", "los", "centroid", "spot_rms", "strehl"))
    np.testing.assert_allclose(one.zernike[:, 3:], other.zernike[:, 3:], rtol=0, atol=1e-6)


def test_a_system_without_segments_is_traced_as_ever():
    lens = wq.load_system("double-gauss")
    pupil = sunflower(0.0, 1.0, 200)
    expected = measure_system(
        prepare_system(lens, pupil.x, pupil.y, pupil.weight, 15), wq.rest_states(lens), NUMPY
    )
    found = wq.trace(lens, rays=200, device="numpy")
    for name in NUMBERS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_mirror_of_one_piece_is_its_parent():
    one = wq.telescope("tmt-thesis")
    found, parent = (wq.trace(each, rays=200, device="numpy") for each in (one, parent_system(one)))
    np.testing.assert_allclose(found.zernike, parent.zernike, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda one: with_surface(one, 2, biconic(one.surfaces[2])),
            "M2 of tmt-18 is more than a round",
        ),
        (lambda one: replace(one, object_distance=1e9), "not those of a first mirror behind the stop"),
    ],
)
def test_figures_that_no_kernel_knows_are_refused(telescope, change, said):
    system = change(with_figures(telescope, 4, 0))
    states = wq.rest_states(system)
    states.segment_figure[0, 3, 3] = 1e-5
    with pytest.raises(UserError, match=said):
        wq.trace(system, states, rays=100)


def test_the_sequential_trace_does_not_ignore_segments(telescope):
    with pytest.raises(UserError, match="M1 of tmt-18 carries segments"):
        pack(telescope, 550e-6)


@pytest.mark.parametrize("name", ["double-gauss", "tmt-18"])
def test_the_plane_is_the_best_one_however_many_terms_are_fitted(name, telescope):
    """The polynomials are not orthogonal at rays; the rms about the plane is the least of all planes."""
    system = telescope if name == "tmt-18" else wq.load_system(name)
    states = wq.rest_states(system, 2)
    states.surface_motion[1, -3] = [
        0.02,
        0.01,
        0.05,
        2e-4,
        1e-4,
        0.0,
    ]  # a mirror, or a lens
    few, many = (wq.trace(system, states, rays=400, terms=terms, device="numpy") for terms in (3, 37))
    for number in ("rms_flat", "pv", "strehl"):
        np.testing.assert_allclose(getattr(few, number), getattr(many, number), rtol=1e-9, err_msg=number)
    assert np.abs(few.zernike[:, 1:3] - many.zernike[:, 1:3]).max() > 1e-6
    assert (many.rms_flat < many.rms_raw).all()
