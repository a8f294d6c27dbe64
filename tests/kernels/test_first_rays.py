"""The first rays of a program are compared as far as rounding lets them be known, and errors are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from segmented_cases import NAMES, OPENCL

from wavequake.errors import UserError
from wavequake.kernels.device import first_batch
from wavequake.kernels.trace import sequential
from wavequake.kernels.trace.packing import packed_elements
from wavequake.kernels.trace.sequence import Element, Moving, Polynomial, Rays, Region, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.shapes import EvenAsphere
from wavequake.optics.systems.kinematics import rest_states

pytestmark = pytest.mark.parametrize("device", OPENCL, ids=NAMES["ids"])
# Of each system a surface, and in how many of the 28 cases below enough rays can be compared.
FOLDED = {
    "gregorian": ("M1", 12),
    "jwst": ("M1", 4),
    "herschel": ("M1", 8),
    "double-gauss": ("surface 5", 28),
    "six-lens": ("L2 back", 28),
    "euv": ("M6", 28),
}
BENDS = (1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5)


@pytest.fixture(autouse=True)
def nothing_trusted(monkeypatch):
    monkeypatch.setattr(first_batch, "_TRUSTED", set())


def folded(name, surface, *bends):
    """The system, one surface of which gains `bends` in rho^4, rho^6, ..."""
    system = optical_system(name)
    surfaces = [
        replace(one, shape=EvenAsphere(one.shape.radius, one.shape.conic, (0.0, *bends)))
        if one.name == surface
        else one
        for one in system.surfaces
    ]
    assert surfaces != list(system.surfaces)
    return replace(system, surfaces=tuple(surfaces))


@cache  # every device and every error takes the same
def case(name, surface=None, bends=(), seed=0, count=60):
    """Arguments of a trace of random rays, also beyond the pupil."""
    system = folded(name, surface, *bends) if surface else optical_system(name)
    wavelength = system.wavelengths[system.primary_wavelength]
    x, y = np.random.default_rng(seed).uniform(-1.2, 1.2, (2, count))
    rays = pupil_rays(optical_system(name), system.fields[0], wavelength, x, y)
    return pack(system, wavelength), rays, moving(system, rest_states(system))


def figured(seed=0):
    """A paraboloid with 28 random terms, then an image."""
    random = np.random.default_rng(seed)
    mirror = Element(
        -1.0 / 4000.0, -1.0, "reflect", polynomial=Polynomial(6, 600.0, random.normal(0.0, 1e-4, 28))
    )
    poses = np.zeros((1, 2, 12))
    poses[..., [0, 4, 8]] = 1.0
    poses[:, :, 11] = [-500.0, 2000.0]
    position = np.vstack([random.uniform(-500.0, 500.0, (2, 60)), np.full(60, -400.0)])
    rays = Rays(position, np.repeat([[0.0], [0.0], [1.0]], 60, axis=1), np.zeros(60))
    return Sequence((mirror, Element())), rays, Moving(poses)


@pytest.mark.parametrize(("name", "surface", "compared"), [(n, *s) for n, s in FOLDED.items()])
def test_aspheres_that_fold_over_are_no_error_of_the_device(name, surface, compared, device):
    trusted = 0
    for bend in BENDS:
        for seed in range(4):
            first_batch._TRUSTED.clear()
            trace_sequence(*case(name, surface, (bend,), seed), device, ignore_apertures=True)
            trusted += len(first_batch._TRUSTED)
    assert trusted >= compared


@pytest.mark.parametrize(
    ("name", "surface"), [("tmt-thesis", "M2"), ("euv", "M3"), ("double-gauss", "surface 3")]
)
def test_random_folds_are_no_error_of_the_device(name, surface, device):
    """Few rays or many, of which most may be lost because an iteration finds nothing."""
    random = np.random.default_rng(5)
    for seed in range(40):
        first_batch._TRUSTED.clear()
        bends = 10.0 ** random.uniform([-13.0, -20.0], [-3.0, -8.0]) * random.choice([-1.0, 1.0], 2)
        count = int(random.integers(1, 300))
        trace_sequence(*case(name, surface, tuple(bends), seed, count), device, ignore_apertures=True)


def longer_path(outputs):
    outputs[0][...] *= 1.0 + 1e-9


def swapped(outputs):
    for x, y in (outputs[1:3], outputs[3:5]):
        x[...], y[...] = y.copy(), x.copy()


def one_lane_off(outputs):
    outputs[1][:, 3::8] += 1e-5


def one_lane_lost(outputs):
    outputs[0][:, 3::8] = np.nan


def spoil(monkeypatch, before=None, after=None):
    """Make the device err: in the fixed numbers or the coefficients that it reads, or in what it writes."""
    launch = sequential.launch

    def spoiled(device, name, constants, size, inputs, outputs, *more):
        changed = list(inputs)
        if before:
            place, change = before
            changed[place] = np.array(inputs[place])
            change(changed[place])
        launch(device, name, constants, size, changed, outputs, *more)
        if after:
            after(outputs)

    monkeypatch.setattr(sequential, "launch", spoiled)


def assert_refused(arguments, device):
    with pytest.raises(UserError, match=r"of \d+ rays of the first batch \d+ differ"):
        trace_sequence(*arguments, device, ignore_apertures=True)
    assert not first_batch._TRUSTED


@pytest.mark.parametrize("name", ["figured", *FOLDED])
@pytest.mark.parametrize("after", [longer_path, swapped, one_lane_off, one_lane_lost])
def test_errors_in_what_is_written_are_found(monkeypatch, name, after, device):
    spoil(monkeypatch, after=after)
    for seed in range(3):
        for count in (17, 60, 1000):
            assert_refused(figured(seed) if name == "figured" else case(name, seed=seed, count=count), device)


@pytest.mark.parametrize("name", FOLDED)
def test_a_wrong_sign_of_any_curvature_is_found(monkeypatch, name, device):
    arguments = case(name)
    shapes = packed_elements(arguments[0], arguments[2], True)[0].shapes
    for shape in shapes:
        if not shape.plane:
            with monkeypatch.context() as patch:
                spoil(patch, before=(1, lambda fixed, place=shape.fixed: np.negative.at(fixed, place)))
                assert_refused(arguments, device)


@pytest.mark.parametrize("share", [0.0, -1.0, 1.1])
def test_any_wrong_coefficient_is_found(monkeypatch, share, device):
    for term in range(28):
        with monkeypatch.context() as patch:
            spoil(patch, before=(8, lambda part, term=term: np.multiply.at(part, term, share)))
            assert_refused(figured(term), device)


@pytest.mark.parametrize("after", [longer_path, swapped])
@pytest.mark.parametrize(
    ("name", "bend"), [("gregorian", 1e-10), ("gregorian", 1e-8), ("double-gauss", 1e-5)]
)
def test_errors_are_found_beside_rays_that_cannot_be_compared(monkeypatch, name, bend, after, device):
    spoil(monkeypatch, after=after)
    assert_refused(case(name, FOLDED[name][0], (bend,)), device)


def test_a_batch_without_light_leaves_the_comparison_to_the_next(device):
    sequence, rays, light = figured()
    for pose in (np.nan, np.inf):
        nowhere = replace(light, poses=np.full_like(light.poses, pose))
        assert np.isnan(trace_sequence(sequence, rays, nowhere, device).path).all()
    none = Rays(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros(0))
    trace_sequence(sequence, none, light, device)
    trace_sequence(sequence, rays, light, device, outputs=("w_sign",))
    assert not first_batch._TRUSTED


@pytest.mark.parametrize("count", [1, 5, 16, 40])
def test_what_is_right_is_trusted_at_any_number_of_rays(count, device):
    sequence, rays, light = figured()
    few = Rays(rays.position[:, :count].copy(), rays.direction[:, :count].copy(), rays.path[:count])
    trace_sequence(sequence, few, light, device)
    assert first_batch._TRUSTED


def test_rays_at_the_very_edge_are_no_error(device):
    """All rays meet the rim of a round opening, where rounding decides which of them pass."""
    sequence, rays, light = figured()
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    rays = replace(rays, position=np.stack([500.0 * np.cos(angle), 500.0 * np.sin(angle), rays.position[2]]))
    rim = replace(sequence.elements[0], regions=(Region("circle", (0.0, 0.0, 500.0)),))
    edged = replace(sequence, elements=(rim, *sequence.elements[1:]))
    traced = trace_sequence(edged, rays, light, device)
    assert 0 < np.isfinite(traced.path).sum() < 60
