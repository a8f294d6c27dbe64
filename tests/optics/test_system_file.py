import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from wavequake import load_study
from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.media.glasses import constant, glass, refractive_index
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    Opening,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.file import SystemSection, build, embed_file
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import Pupil
from wavequake.optics.zemax.read import read_zmx

COOKE = Path(__file__).parents[1] / "data" / "cooke_triplet.zmx"

TRIPLET = """
[system]
name = "Cooke triplet f/5"
entrance_diameter_mm = 10.0
fields_deg = [[0.0, 0.0], [0.0, 14.0], [0.0, 20.0]]
wavelengths_nm = [480.0, 550.0, 650.0]
primary_wavelength = 2
surface = [
    {name = "front", radius_mm = 22.01355747, glass = "N-SK16", semi_diameter_mm = 9.5},
    {name = "surface 2", radius_mm = -435.76004006, distance_mm = 3.258956, glass = "air"},
    {name = "surface 3", radius_mm = -22.21328293, distance_mm = 6.007551, glass = "F2"},
    {name = "surface 4", radius_mm = 20.29197059, distance_mm = 0.9999746, glass = "air", stop = true},
    {name = "surface 5", radius_mm = 79.68369582, distance_mm = 4.750409, glass = "N-SK16"},
    {name = "surface 6", radius_mm = -18.39532013, distance_mm = 2.952076, glass = "air"},
    {name = "image", distance_mm = 42.20778},
]
"""


def section(text):
    return SystemSection.model_validate(tomllib.loads(text)["system"])


def table(*rows, top="entrance_diameter_mm = 10.0\nwavelengths_nm = [550.0]"):
    return build(section(f"[system]\n{top}\nsurface = [{','.join(rows)}]"))


def test_a_table_of_surfaces_is_the_system_of_the_lens_file():
    ours, theirs = build(section(TRIPLET)), read_zmx(COOKE)
    assert (ours.name, ours.stop, ours.pupil) == (theirs.name, theirs.stop, theirs.pupil)
    assert ours.primary_wavelength == theirs.primary_wavelength
    np.testing.assert_allclose(ours.fields, theirs.fields, rtol=1e-15)
    np.testing.assert_allclose(ours.wavelengths, theirs.wavelengths, rtol=1e-15)
    for one, other in zip(ours.surfaces, theirs.surfaces, strict=True):
        assert one.shape.radius == pytest.approx(other.shape.radius, rel=1e-7)
        np.testing.assert_allclose(one.position, other.position, rtol=1e-14)
        np.testing.assert_array_equal(one.rotation, np.eye(3))
        for name in ("name", "action", "medium", "opening", "deformation"):
            assert getattr(one, name) == getattr(other, name)


def test_a_lens_file_becomes_part_of_the_study(tmp_path):
    record = {"file": COOKE.name, "f_number": 4.0}
    embed_file(record, COOKE.parent)
    again = SystemSection.model_validate_json(SystemSection.model_validate(record).model_dump_json())
    assert again.file is None
    system, original = build(again), read_zmx(COOKE)
    assert system.pupil == Pupil("f_number", 4.0)  # what stands beside the file replaces what it says
    assert system.surfaces[3].medium == original.surfaces[3].medium
    np.testing.assert_array_equal(system.fields, original.fields)
    with pytest.raises(UserError, match=r"none\.zmx cannot be read"):
        embed_file({"file": "none.zmx"}, tmp_path)


def test_a_section_with_a_path_reads_it():
    assert build(SystemSection(file=str(COOKE))).name == "Cooke triplet f/5"


def test_a_bundled_system_by_name():
    system = build(SystemSection(name="double-gauss", f_number=4.0))
    assert system.pupil.kind == "f_number"
    assert len(system.surfaces) == len(optical_system("double-gauss").surfaces)
    with pytest.raises(UserError, match="double-gauss"):
        build(SystemSection(name="double-gaus"))


def test_shapes_openings_and_media():
    system = table(
        '{name = "a", radius_mm = 100.0, conic = -1.0, even_asphere = [0.0, 1e-6], glass = 1.5}',
        '{name = "b", polynomial_mm = [0.0, 0.1], normalization_radius_mm = 7.0, distance_mm = 2.0}',
        '{name = "c", zernike_nm = [0.0, 0.0, 0.0, 25.0], semi_diameter_mm = 9.0, inner_mm = 1.0,'
        "stop = true}",
        '{name = "d", deformation_terms = 15, semi_diameter_mm = 8.0, arms = [[90.0, 0.5]],'
        "center_mm = [3.0, 4.0]}",
        '{name = "e", corners_mm = [[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]]}',
        '{name = "f", dark_mm = [[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]],'
        "decenter_mm = [1.0, -2.0], distance_mm = 3.0}",
        '{name = "image", distance_mm = 5.0}',
    )
    a, b, c, d, e, f, image = system.surfaces
    assert a.shape == EvenAsphere(100.0, -1.0, (0.0, 1e-6))
    assert (a.action, a.medium) == ("refract", constant(1.5))
    assert b.shape == ExtendedPolynomial(np.inf, 0.0, (0.0, 0.1), 7.0)
    assert b.action == "pass"
    assert c.shape == ZernikeSag(np.inf, 0.0, (0.0, 0.0, 0.0, pytest.approx(25e-6)), 9.0)
    assert c.opening == Opening(outer=9.0, inner=1.0)
    assert d.deformation == ZernikeDeformation(15, 13.0)  # about the vertex, to the opening's far edge
    assert d.opening == Opening(outer=8.0, arms=((pytest.approx(np.pi / 2), 0.5),), center=(3.0, 4.0))
    assert e.opening == Opening(corners=((-1.0, -1.0), (1.0, -1.0), (0.0, 1.0)))
    assert f.opening == Opening(dark=((-1.0, -1.0), (1.0, -1.0), (0.0, 1.0)))
    np.testing.assert_allclose(f.position, [1, -2, 5])
    np.testing.assert_allclose(image.position, [0, 0, 10])
    assert image.shape == Conic()
    assert system.stop == 2


def test_distances_run_along_the_light():
    """A Cassegrain: back to the secondary, forth through the hole of the primary."""
    system = table(
        '{name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true}',
        '{name = "M2", radius_mm = -800.0, distance_mm = 700.0, glass = "mirror"}',
        '{name = "image", distance_mm = 900.0}',
    )
    assert [surface.position[2] for surface in system.surfaces] == [0.0, -700.0, 200.0]
    assert [surface.action for surface in system.surfaces] == ["reflect", "reflect", "pass"]


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-180, 180))
def test_a_fold_mirror_sends_the_chief_ray_along_the_new_axis(a, b, c):
    system = table(
        f'{{name = "fold", tilt_deg = [{a!r}, {b!r}, {c!r}], glass = "mirror", fold = true, stop = true}}',
        '{name = "after", distance_mm = 10.0, glass = "mirror"}',
        '{name = "image", distance_mm = 30.0}',
    )
    mirror, after, image = system.surfaces
    normal = mirror.rotation[:, 2]
    ray = np.array([0.0, 0.0, 1.0]) - 2.0 * normal[2] * normal  # the law of reflection
    np.testing.assert_allclose(after.position, 10.0 * ray, rtol=0, atol=1e-12)
    np.testing.assert_allclose(image.position, -20.0 * ray, rtol=0, atol=1e-12)  # met head-on, it comes back
    np.testing.assert_allclose(after.rotation[:, 2], -ray, rtol=0, atol=1e-13)  # z keeps its sense
    np.testing.assert_allclose(after.rotation @ after.rotation.T, np.eye(3), rtol=0, atol=1e-13)
    assert np.linalg.det(after.rotation) == pytest.approx(1.0)


def test_a_fold_agrees_with_a_pair_of_coordinate_breaks():
    """Störkle 2018, Table 4.2: between two breaks of 45 degrees stands a flat mirror at 45 degrees."""
    system = table(
        '{name = "fold", tilt_deg = [0.0, 45.0, 0.0], glass = "mirror", fold = true, stop = true}',
        '{name = "image", distance_mm = 10.0}',
    )
    image = system.surfaces[1]
    np.testing.assert_allclose(image.position, [-10.0, 0.0, 0.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(image.rotation, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], rtol=0, atol=1e-15)


def test_finite_objects_fields_and_pupils():
    rows = ('{name = "lens", stop = true}', '{name = "image", distance_mm = 1.0}')
    waves = "wavelengths_nm = [248.3]"
    near = (
        f"object_na = 0.2\n{waves}\nobject_distance_mm = 30.0\nfields_mm = [[0.0, 5.0]]\ntelecentric = true"
    )
    system = table(*rows, top=near)
    assert system.pupil == Pupil("object_na", 0.2)
    assert (system.object_distance, system.telecentric) == (30.0, True)
    np.testing.assert_array_equal(system.fields, [[0.0, 5.0]])
    far = table(
        *rows, top=f"stop_radius_mm = 3.0\npupil_obscuration = 0.3\n{waves}\nfields_arcmin = [[0.0, 30.0]]"
    )
    assert far.pupil == Pupil("stop", 3.0, 0.3)
    np.testing.assert_allclose(far.fields, [[0.0, np.pi / 360]])
    with pytest.raises(UserError, match="fields_mm instead of fields_deg"):
        table(*rows, top=f"f_number = 2.0\n{waves}\nobject_distance_mm = 30.0\nfields_deg = [[0.0, 1.0]]")
    with pytest.raises(UserError, match="at infinity: give fields_deg or fields_arcmin"):
        table(*rows, top=f"f_number = 2.0\n{waves}\nfields_mm = [[0.0, 1.0]]")
    with pytest.raises(UserError, match="give its fields anew"):
        build(SystemSection(file=str(COOKE), object_distance_mm=100.0))
    with pytest.raises(UserError, match=r"primary_wavelength is 4, but .* has 3"):
        build(SystemSection(file=str(COOKE), primary_wavelength=4))


def test_an_unknown_glass_names_its_surface():
    with pytest.raises(UserError, match=r"The surface lens: There is no glass 'N-BK77'"):
        table('{name = "lens", glass = "N-BK77", stop = true}', '{name = "image"}')
    assert table('{name = "a", glass = "n-bk7", stop = true}', '{name = "i"}').surfaces[0].medium == glass(
        "N-BK7"
    )


def test_mirrors_and_planes_as_users_write_them():
    mirrors = [
        table(f'{{name = "a", {radius} glass = "{glass}", stop = true}}', '{name = "i", distance_mm = 9.0}')
        for glass, radius in (("mirror", ""), ("Mirror", "radius_mm = inf,"), ("MIRROR", "radius_mm = -inf,"))
    ]
    assert [one.surfaces[0].action for one in mirrors] == ["reflect"] * 3
    assert [one.surfaces[0].shape for one in mirrors] == [Conic(np.inf)] * 3
    with pytest.raises(UserError, match=r'no glass \'miror\' .* Did you mean "mirror"\?'):
        table('{name = "a", glass = "miror", stop = true}', '{name = "i"}')


def test_a_plane_is_the_same_study_however_it_is_written():
    whole = WHOLE | {"surface": [LENS | {"radius_mm": float("inf"), "glass": "Mirror"}, IMAGE]}
    plain = WHOLE | {"surface": [LENS | {"glass": "mirror"}, IMAGE]}
    assert SystemSection.model_validate(whole) == SystemSection.model_validate(plain)


LENS, IMAGE = {"name": "lens", "stop": True}, {"name": "image"}
WHOLE = {"entrance_diameter_mm": 1.0, "wavelengths_nm": [500.0], "surface": [LENS, IMAGE]}


@pytest.mark.parametrize(
    ("record", "match"),
    [
        ({}, "name of a bundled system, a file, or surfaces"),
        ({"file": "a.zmx", "name": "b"}, "file stands alone"),
        (WHOLE | {"f_number": 2.0}, "entrance_diameter_mm and f_number"),
        ({"wavelengths_nm": [500.0], "surface": [LENS, IMAGE]}, "one of entrance_diameter_mm"),
        ({"entrance_diameter_mm": 1.0, "surface": [LENS, IMAGE]}, "needs wavelengths_nm"),
        (WHOLE | {"wavelengths_nm": [-500.0]}, "must be positive"),
        (WHOLE | {"fields_deg": [[0.0, 0.0]], "fields_mm": [[0.0, 0.0]]}, "choose one"),
        (WHOLE | {"surface": [IMAGE]}, "exactly one surface is the stop; none"),
        (WHOLE | {"surface": [LENS, LENS | {"name": "b"}]}, "lens, b has stop"),
        (WHOLE | {"surface": [LENS, IMAGE | {"name": "lens"}]}, "two surfaces are called 'lens'"),
        (WHOLE | {"surface": [LENS, IMAGE | {"glass": "mirror"}]}, "is the image"),
        (WHOLE | {"surface": [LENS | {"radius_mm": 0.0}, IMAGE]}, "leave radius_mm out"),
        (WHOLE | {"surface": [LENS | {"radius_mm": float("nan")}, IMAGE]}, "finite number"),
        (WHOLE | {"surface": [LENS | {"zernike_nm": [1.0]}, IMAGE]}, "normalization_radius_mm"),
        (WHOLE | {"surface": [LENS | {"zernike_nm": [1.0], "even_asphere": [1.0]}, IMAGE]}, "choose one"),
        (WHOLE | {"surface": [LENS | {"semi_diameter_mm": 1.0, "inner_mm": 1.0}, IMAGE]}, "passes no light"),
        (WHOLE | {"surface": [LENS | {"corners_mm": [[0.0, 1.0]]}, IMAGE]}, "at least 3 corners_mm"),
        (WHOLE | {"surface": [LENS | {"dark_mm": [[0.0, 1.0]]}, IMAGE]}, "at least 3 corners of dark_mm"),
        (WHOLE | {"surface": [LENS | {"arms": [[0.0, 0.0]]}, IMAGE]}, "arm without a positive width"),
        (WHOLE | {"surface": [LENS | {"fold": True}, IMAGE]}, "folds the axis"),
        (WHOLE | {"surface": [LENS | {"glass": -1.5}, IMAGE]}, "must be positive"),
        (WHOLE | {"surface": [LENS | {"thickness": 1.0}, IMAGE]}, "Extra inputs"),
    ],
)
def test_bad_sections_are_refused(record, match):
    with pytest.raises(ValidationError, match=match):
        SystemSection.model_validate(record)


def test_a_section_survives_its_json():
    one = section(TRIPLET)
    again = SystemSection.model_validate_json(one.model_dump_json())
    assert again == one
    assert replace(build(again), fields=0, wavelengths=0, surfaces=()) == replace(
        build(one), fields=0, wavelengths=0, surfaces=()
    )


@given(st.floats(-40, 40), st.floats(-40, 40))
def test_a_folded_telescope_focuses_on_its_image(a, b):
    """A parabola with a focal length of 1000 mm; its path of 800 + 200 mm is folded by any flat."""
    system = table(
        '{name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true}',
        f'{{name = "flat", distance_mm = 800.0, tilt_deg = [{a!r}, {b!r}, 0.0],'
        'glass = "mirror", fold = true}',
        '{name = "image", distance_mm = 200.0}',
    )
    radius, angle = np.linspace(10, 100, 5), np.linspace(0, 6, 5)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(5, -900.0)])
    rays = Rays(position, np.array([[0.0], [0.0], [1.0]]) * np.ones(5), np.zeros(5))
    traced = trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)))
    np.testing.assert_allclose(np.stack([traced.x[0], traced.y[0]]), 0.0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(traced.path[0], 900 + 1000, rtol=1e-13)


def test_the_table_of_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "systems.md").read_text()
    text = page.split("```text\n")[1].split("```")[0]
    system = build(section(text))
    assert [surface.name for surface in system.surfaces] == ["M1", "flat", "image"]
    # The flat faces (0, -1, 1), so light along -z leaves along -y.
    np.testing.assert_allclose(system.surfaces[2].position, [0.0, -200.0, -800.0], rtol=0, atol=1e-12)


def test_glasses_of_the_user_become_part_of_a_study(tmp_path):
    """Of a catalogue those that the system uses, by their formulas; others are given in the study itself."""
    agf = (
        "NM MELT 1 0 1.6 60\nCD 2.56 0 0 0 0 0\nLD 0.3 2\nNM OTHER 1 0 1.7 60\nCD 2.89 0 0 0 0 0\nLD 0.3 2\n"
    )
    (tmp_path / "mine.agf").write_text(agf)
    surfaces = (
        '[{ name = "a", glass = "melt", stop = true }, { name = "b", glass = "crown", distance_mm = 1.0 },'
    )
    surfaces += ' { name = "image", distance_mm = 1.0 }]'
    text = f"""
[study]
name = "own"
workflow = "system-disturbance"
[system]
entrance_diameter_mm = 1.0
wavelengths_nm = [587.5618]
glass_file = "mine.agf"
surface = {surfaces}
[system.glass.crown]
index = 1.523
abbe = 58.6
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["a"]
lines = [{{ frequency_hz = 85.0, amplitude = {{ dy_um = 3.0 }} }}]
"""
    (tmp_path / "own.toml").write_text(text)
    study = load_study(tmp_path / "own.toml")
    assert set(study.system.glass) == {"MELT", "crown"}
    (tmp_path / "mine.agf").rename(tmp_path / "away.agf")  # the study has what it needs
    system = build(study.system)
    indices = [refractive_index(surface.medium, 587.5618e-6) for surface in system.surfaces[:2]]
    assert indices == pytest.approx([1.6, 1.523], abs=1e-12)
    (tmp_path / "away.agf").rename(tmp_path / "mine.agf")
    (tmp_path / "own.toml").write_text(text.replace("abbe = 58.6", ""))
    with pytest.raises(UserError, match="either formula and coefficients, or index and abbe"):
        load_study(tmp_path / "own.toml")
