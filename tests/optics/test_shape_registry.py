"""What every registered shape owes, the package's own and one that a file outside of it adds."""

import pickle
import tomllib
from dataclasses import replace

import cylinder_shape
import numpy as np
import pytest

import wavequake as wq
from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.glasses import constant
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.forms.biconic import Biconic
from wavequake.optics.shapes.forms.forbes_asphere import ForbesAsphere
from wavequake.optics.shapes.forms.odd_asphere import OddAsphere
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.sag import shape_sag, vertex_curvature
from wavequake.optics.shapes.shape import SHAPES, Shape, register
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, ExtendedPolynomial, GridSag, ZernikeSag
from wavequake.optics.systems.file import SystemSection, build
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Pupil, States, Surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx
from wavequake.registry import Registry

RNG = np.random.default_rng(4)
RAY = 30.0  # mm
FLAT = "radius_mm = -300.0\nconic = -0.5\n"
# An example of each and how a study file says it.
EXAMPLES = {
    "Conic": (Conic(-300.0, -0.5), FLAT),
    "EvenAsphere": (EvenAsphere(-300.0, -0.5, (1e-5, -2e-8)), FLAT + "even_asphere = [1e-5, -2e-8]"),
    "ExtendedPolynomial": (
        ExtendedPolynomial(-300.0, -0.5, (0.01, 0.02, -0.3, 0.1, 0.2), 50.0),
        FLAT + "polynomial_mm = [0.01, 0.02, -0.3, 0.1, 0.2]\nnormalization_radius_mm = 50.0",
    ),
    "ZernikeSag": (
        ZernikeSag(-300.0, -0.5, (0.0, 1e-3, 0.0, 2e-3, 0.0, 1e-3), 50.0),
        FLAT + "zernike_nm = [0.0, 1e3, 0.0, 2e3, 0.0, 1e3]\nnormalization_radius_mm = 50.0",
    ),
    "GridSag": (
        GridSag(-300.0, -0.5, np.round(RNG.normal(size=(9, 12)), 2) * 1e-2, 12.0, 14.0),
        None,
    ),
    "OddAsphere": (
        OddAsphere(-300.0, -0.5, (0.0, 1e-5, -2e-7, 3e-9)),
        FLAT + "odd_asphere = [0.0, 1e-5, -2e-7, 3e-9]",
    ),
    "Biconic": (
        Biconic(-300.0, -0.5, 250.0, -1.5),
        FLAT + "biconic_radius_mm = 250.0\nbiconic_conic = -1.5",
    ),
    "Toroid": (
        Toroid(-300.0, -0.5, 200.0, (1e-5, -2e-8)),
        FLAT + "toroid_radius_mm = 200.0\ntoroid_coefficients = [1e-5, -2e-8]",
    ),
    "ForbesAsphere": (
        ForbesAsphere(-300.0, -0.5, (0.3, -0.1, 0.05), 50.0, "bfs"),
        FLAT + "qbfs_mm = [0.3, -0.1, 0.05]\nnormalization_radius_mm = 50.0",
    ),
    "Cylinder": (cylinder_shape.Cylinder(-300.0, -0.5, 400.0), FLAT + "cylinder_radius_mm = 400.0"),
}


def system_of(shape):
    mirror = Surface("mirror", shape, action="reflect")
    image = Surface("image", position=np.array([0.0, 0.0, -150.0]))
    return OpticalSystem("one mirror", (mirror, image), 0, Pupil("entrance_diameter", 40.0))


def test_every_registered_shape_has_an_example():
    own = {
        name: shape
        for name, shape in SHAPES.entries().items()
        if shape.__module__.startswith("wavequake.") or shape is cylinder_shape.Cylinder
    }
    assert {name: type(shape) for name, (shape, _) in EXAMPLES.items()} == own


@pytest.mark.parametrize("name", EXAMPLES)
def test_slopes_and_curvature_are_derivatives_of_the_sag(name):
    shape = EXAMPLES[name][0]
    x, y = RNG.uniform(-RAY, RAY, (2, 40))
    z, slope_x, slope_y = shape_sag(shape, x, y)
    for step_x, step_y, slope in ((1e-3, 0.0, slope_x), (0.0, 1e-3, slope_y)):
        ahead, back = (shape_sag(shape, x + s * step_x, y + s * step_y)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(slope, (ahead - back) / 2e-3, rtol=0, atol=2e-9)
    h = 0.05
    cross = [shape_sag(shape, *at)[0] for at in ((h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h))]
    around = (sum(cross) - 4.0 * shape_sag(shape, 0.0, 0.0)[0]) / (2.0 * h**2)
    assert vertex_curvature(shape) == pytest.approx(float(around), rel=1e-4)
    assert z.shape == x.shape


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.parametrize("device", list_devices(), ids=lambda device: device.kind)
def test_rays_end_on_it_and_come_back_the_same_way(name, device):
    """Light that leaves glass where it came in goes back on itself: the index of the path is reversible."""
    shape = EXAMPLES[name][0]
    x, y, u, v = RNG.uniform([[-RAY], [-RAY], [-0.1], [-0.1]], [[RAY], [RAY], [0.1], [0.1]], (4, 32))
    d = np.stack([u, v, np.sqrt(1.0 - u**2 - v**2)])
    start = np.stack([x, y, np.zeros(32)]) - 50.0 * d

    def traced(index_before, index_after, position, direction):
        one = Surface("surface", shape, action="refract", medium=constant(index_after))
        system = OpticalSystem(
            "one",
            (one, Surface("image")),
            0,
            Pupil("entrance_diameter", 1.0),
            medium=constant(index_before),
        )
        rest = moving(system, States(np.zeros((1, 2, 6)), (None, None), np.zeros((1, 2))))
        sequence = pack(system, 550e-6)
        first = type(sequence)(sequence.elements[:1], sequence.index)
        rays = Rays(position, direction, np.zeros(32))
        found = trace_sequence(first, rays, type(rest)(rest.poses[:, :1]), device)
        assert (found.status == OK).all()
        w = found.w_sign[0] * np.sqrt(1.0 - found.u[0] ** 2 - found.v[0] ** 2)
        z = shape_sag(shape, found.x[0], found.y[0])[0]
        return np.stack([found.x[0], found.y[0], z]), np.stack([found.u[0], found.v[0], w]), found.path[0]

    hit, into, path = traced(1.0, 1.5, start, d)
    np.testing.assert_allclose(hit, start + path * d, rtol=0, atol=1e-11)
    again, back, _ = traced(1.5, 1.0, hit + 20.0 * into, -into)
    np.testing.assert_allclose(again, hit, rtol=0, atol=1e-11)
    np.testing.assert_allclose(back, -d, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", EXAMPLES)
def test_files_and_pickles_keep_it(name):
    shape, keys = EXAMPLES[name]
    x, y = RNG.uniform(-RAY, RAY, (2, 20))

    def assert_same(other, tolerance=0.0):
        assert type(other) is type(shape)
        np.testing.assert_allclose(shape_sag(other, x, y), shape_sag(shape, x, y), rtol=0, atol=tolerance)

    assert_same(pickle.loads(pickle.dumps(shape)))
    if name == "GridSag":
        keys = FLAT + f"sag_mm = {shape.heights.tolist()}\nsag_spacing_mm = [12.0, 14.0]"
    record = tomllib.loads(
        'entrance_diameter_mm = 40.0\nwavelengths_nm = [550.0]\n[[surface]]\nname = "mirror"\nstop = true\n'
        f'glass = "mirror"\n{keys}\n[[surface]]\nname = "image"\ndistance_mm = 150.0'
    )
    section = SystemSection.model_validate(record)
    assert_same(build(section).surfaces[0].shape, 1e-15)
    again = SystemSection.model_validate_json(section.model_dump_json(), strict=False)
    assert again == section
    assert_same(build(again).surfaces[0].shape, 1e-15)
    system = system_of(shape)
    assert_same(parse_zmx(zmx_text(system), "written").surfaces[0].shape, 1e-12)
    assert name in wq.info(system) or name == "Conic"


def test_a_shape_without_a_surface_type_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(cylinder_shape.Cylinder, "zemax", "")
    with pytest.raises(UserError, match=r"mirror of one mirror is a Cylinder, for which lens files have no"):
        zmx_text(system_of(EXAMPLES["Cylinder"][0]))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            "cylinder_radius_mm = 'long'",
            r"surface.mirror.cylinder_radius_mm: input should be a valid number",
        ),
        (
            "cylinder_radius_mm = 10.0\neven_asphere = [1.0]",
            r"even_asphere and cylinder_radius_mm; choose one",
        ),
        ("cylinder_radius_mm = 0.0", r"the surface mirror of custom: the radius of a Cylinder along x is 0"),
        ("cylinder_radius = 10.0", "cylinder_radius"),
    ],
)
def test_wrong_keys_of_an_added_shape_are_named(tmp_path, keys, message):
    with pytest.raises(UserError, match=message):
        wq.info(wq.load_system(loaded(tmp_path, keys)))


def test_two_shapes_cannot_share_a_name_or_a_key():
    class Cylinder(Shape):
        pass

    with pytest.raises(UserError, match="two shapes are called 'Cylinder'"):
        register(Cylinder)
    Cylinder.__name__ = "Tube"
    Cylinder.keys = cylinder_shape.CylinderKeys
    with pytest.raises(UserError, match="Cylinder and Tube have the same key 'cylinder_radius_mm'"):
        register(Cylinder)


def test_modules_of_other_distributions_are_found_by_entry_points(monkeypatch):
    class Point:
        name, value, dist = "tube", "nowhere:Tube", None

        def load(self):
            raise ImportError("there is no module nowhere")

    monkeypatch.setattr("wavequake.registry.entry_points", lambda group: [Point()])
    registry = Registry("shape", "wavequake.optics.shapes.forms", "some.group", lambda shape: shape.__name__)
    with pytest.raises(UserError, match="the shape 'tube' of the installed package nowhere:Tube cannot be"):
        registry.entries()


STUDY = """
[study]
name = "cylinder"
workflow = "system-disturbance"
[campaign]
cases = 2
device = "numpy"
[optics]
rays = 60
[wavefront]
zernike_terms = 11
[system]
entrance_diameter_mm = 40.0
wavelengths_nm = [550.0]
[[system.surface]]
name = "mirror"
glass = "mirror"
stop = true
semi_diameter_mm = 25.0
KEYS
[[system.surface]]
name = "image"
distance_mm = 150.0
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["mirror"]
rms = { dz_um = 1.0 }
[[disturbance]]
name = "figure"
model = "surface-deformation"
of = ["mirror"]
rms_nm = { 5 = 10.0 }
"""


def loaded(tmp_path, keys):
    path = tmp_path / "cylinder.toml"
    path.write_text(STUDY.replace("KEYS", keys))
    return path


def test_a_study_runs_on_an_added_shape(tmp_path, wavequake):
    """Its figure is drawn and seen as on any other mirror, and `info` names it."""
    path = loaded(tmp_path, "radius_mm = -300.0\ncylinder_radius_mm = 1e6")
    done = wq.run(path, store=tmp_path / "store")
    assert (done["status"] == DONE).all()
    sphere = wq.run(loaded(tmp_path, "radius_mm = -300.0"), store=tmp_path / "sphere")
    # So weak a cylinder hardly changes how the same figure turns light.
    np.testing.assert_allclose(done["wfe_change"], sphere["wfe_change"], rtol=2e-3)
    loaded(tmp_path, "radius_mm = -300.0\ncylinder_radius_mm = 1e6")
    code, out, err = wavequake("info", path)
    assert code == 0, err
    assert "Cylinder" in out
    code, _, err = wavequake("export", tmp_path / "store", tmp_path / "cases.csv")
    assert code == 0, err
    lens = wq.write_zmx(wq.load_system(path), tmp_path / "cylinder.zmx")
    assert wq.load_system(lens).surfaces[0].shape == cylinder_shape.Cylinder(-300.0, 0.0, 1e6)


def test_a_cylinder_is_astigmatic_by_its_curvature(tmp_path):
    """x^2 / (2 R) on a mirror is twice that in the wavefront: Noll 4 and 6 in the ratio sqrt(3) : sqrt(6)."""
    found = {}
    for name, shape in (("sphere", Conic(-300.0, -1.0)), ("sum", cylinder_shape.Cylinder(-300.0, -1.0, 1e6))):
        system = replace(system_of(shape), wavelengths=np.array([550e-6]))
        rays = sunflower(0.0, 1.0, 2000)
        prepared = prepare_system(system, rays.x, rays.y, rays.weight, 11)
        found[name] = measure_system(prepared, rest_states(system), NUMPY).zernike[0] * 550e-6
    change = found["sum"] - found["sphere"]
    # W = 2 x^2 / (2 R) = a^2 / R (rho^2 / 2 + rho^2 cos(2 theta) / 2) for a pupil of radius a.
    half = 20.0**2 / 1e6 / 2.0
    sign = np.sign(change[3])
    np.testing.assert_allclose(sign * change[3], half / (2.0 * np.sqrt(3.0)), rtol=1e-2)
    np.testing.assert_allclose(sign * change[5], half / np.sqrt(6.0), rtol=1e-2)
