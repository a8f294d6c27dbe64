"""Heights on a grid from files, in a table of surfaces."""

import numpy as np
import pytest
from pydantic import ValidationError

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.sag_file import read_sag
from wavequake.optics.shapes.shapes import GridSag
from wavequake.optics.systems.file import SystemSection, build, embed_file
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

HEIGHTS = np.arange(30.0).reshape(5, 6) ** 2 / 1e3


def dat(path, heights, head, unit=1.0, comment=""):
    """Zemax's order: the first node is the upper left one, x runs first, then y downwards."""
    lines = [f"{float(height / unit)!r} 0 0 0" for height in heights[::-1].ravel()]
    path.write_text("\n".join([*([comment] if comment else []), head, *lines]))


def test_csv_and_npy_hold_rows_from_the_lowest_y(tmp_path):
    np.save(tmp_path / "sag.npy", HEIGHTS)
    text = "\n".join(",".join(repr(float(v)) for v in row) for row in HEIGHTS)
    (tmp_path / "sag.csv").write_text(f"# mm\n{text}\n\n")
    for name in ("sag.npy", "sag.csv"):
        table = read_sag(tmp_path / name)
        np.testing.assert_array_equal(table.heights, HEIGHTS)
        assert table.spacing is None


@pytest.mark.parametrize(("flag", "unit"), [(0, 1.0), (1, 10.0), (2, 25.4), (3, 1000.0)])
def test_a_grid_file_starts_at_the_upper_left_node_and_has_units(tmp_path, flag, unit):
    dat(tmp_path / "sag.dat", HEIGHTS, f"6 5 0.2 -0.3 {flag} 0 0", unit, "! sag")
    table = read_sag(tmp_path / "sag.dat")
    np.testing.assert_allclose(table.heights, HEIGHTS, rtol=1e-15)
    assert table.spacing == pytest.approx((0.2 * unit, 0.3 * unit))


def section(surface):
    return {
        "entrance_diameter_mm": 20.0,
        "wavelengths_nm": [550.0],
        "surface": [
            {"name": "M1", "glass": "mirror", "stop": True, "radius_mm": -400.0} | surface,
            {"name": "image", "distance_mm": 200.0},
        ],
    }


def record(tmp_path, surface):
    found = section(surface)
    embed_file(found, tmp_path)
    return found


def test_a_slope_tilts_the_light_by_twice_as_much_in_the_right_direction(tmp_path):
    """Heights that grow along y: light to +z turns towards -y after the mirror, which sends it to -z."""
    y = 4.0 * (np.arange(9) - 4)
    np.save(tmp_path / "tilt.npy", np.repeat(1e-4 * y[:, None], 7, axis=1))
    one = record(tmp_path, {"sag_file": "tilt.npy", "sag_spacing_mm": [5.0, 4.0]})
    system = build(SystemSection.model_validate(one))
    assert isinstance(system.surfaces[0].shape, GridSag)
    start = Rays(np.array([[1e-9], [0.0], [-10.0]]), np.array([[0.0], [0.0], [1.0]]), np.zeros(1))
    traced = trace_sequence_numpy(pack(system, 550e-6), start, moving(system, rest_states(system)))
    # Slope s = 1e-4: the normal is (0, -s, 1), the reflected ray (0, 2 s, -1 + s^2) / (1 + s^2).
    np.testing.assert_allclose(traced.v[0], 2e-4, rtol=1e-7)
    np.testing.assert_allclose(traced.y[0], 200 * np.tan(2 * np.arctan(1e-4)), rtol=1e-7)


def test_a_grid_is_the_zernike_sag_that_it_samples(tmp_path):
    """Astigmatism sqrt(6) a (x^2 - y^2) / r^2 of 30 nm rms on M1, as a table and as a polynomial."""
    x, y = np.meshgrid(np.linspace(-12, 12, 49), np.linspace(-12, 12, 49))
    np.savetxt(tmp_path / "figure.csv", np.sqrt(6) * 30e-6 * (x**2 - y**2) / 100.0, delimiter=",")
    spherical = {"conic": -1.0}
    grid = record(tmp_path, spherical | {"sag_file": "figure.csv", "sag_spacing_mm": [0.5, 0.5]})
    term = {"zernike_nm": [0, 0, 0, 0, 0, 30.0], "normalization_radius_mm": 10.0}
    term["zernike_nm"] = [float(v) for v in term["zernike_nm"]]
    points = sunflower(0.0, 1.0, 80)
    found = []
    for one in (grid, section(spherical | term)):
        system = build(SystemSection.model_validate(one))
        prepared = prepare_system(system, points.x, points.y, points.weight, 11)
        found.append(measure_system(prepared, rest_states(system), NUMPY).zernike[0])
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-8)  # the spline is exact for squares
    # A mirror that stands h further along the light lengthens the path by 2 h, nearly so at f/10.
    assert found[0][5] * 550 == pytest.approx(-60.0, rel=2e-3)


def test_the_heights_belong_to_the_study_and_the_name_of_the_file_does_not(tmp_path):
    dat(tmp_path / "sag.dat", HEIGHTS, "6 5 2.0 3.0 0 0 0")
    one = SystemSection.model_validate(record(tmp_path, {"sag_file": "sag.dat"}))
    text = one.model_dump_json()
    assert "sag.dat" not in text
    shape = build(SystemSection.model_validate_json(text)).surfaces[0].shape
    np.testing.assert_array_equal(shape.heights, HEIGHTS)
    assert (shape.dx, shape.dy) == (2.0, 3.0)


def test_a_section_made_in_python_reads_its_file_when_it_is_built(tmp_path):
    dat(tmp_path / "sag.dat", HEIGHTS, "6 5 2.0 3.0 0 0 0")
    one = SystemSection.model_validate(section({"sag_file": str(tmp_path / "sag.dat")}))
    np.testing.assert_array_equal(build(one).surfaces[0].shape.heights, HEIGHTS)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("sag.txt", "1,2", r"\.csv, \.npy or \.dat"),
        ("sag.csv", "", "4 of each"),
        ("sag.csv", "1,2,3\n1,2", "line 2: it has 2 heights, the first row 3"),
        ("sag.csv", "1,2,3,x", "are not numbers"),
        ("sag.csv", "\n".join(["1,2,3,4"] * 3), "4 of each"),
        ("sag.csv", "\n".join(["1,2,3,4"] * 4 + ["1,2,nan,4"]), "row 5 and column 3"),
        ("sag.npy", "no array", "no NumPy array"),
        ("sag.npy", "", "no NumPy array .*reading magic string, expected 8 bytes got 0"),
        ("sag.npy", "PK\x03\x04", "holds several arrays"),
        ("sag.dat", "-5 -5 1 1 0 0 0\n" + "0 0 0 0\n" * 25, "nx, ny above 0"),
        ("sag.dat", "1e300 5 1 1 0 0 0", "at most 262144 nodes"),
        ("sag.dat", "", "is empty"),
        ("sag.dat", "5 5 1 1", "nx ny delx dely unitflag"),
        ("sag.dat", "5 5 1 1 7 0 0", "unit flag from 0"),
        ("sag.dat", "5.5 5 1 1 0 0 0", "whole numbers"),
        ("sag.dat", "5 5 1 1 0 0.5 0", "decentered"),
        ("sag.dat", "5 5 1 1 0 0 0\n0 0 0 0", "1 nodes follow"),
        ("sag.dat", "4 4 1 1 0 0 0\n" + "0 0 0 0 1\n" * 16, "has no data"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, name, content, match):
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=match):
        read_sag(tmp_path / name)
    with pytest.raises(UserError, match="cannot be read"):
        read_sag(tmp_path / "missing.csv")


@pytest.mark.parametrize(
    ("surface", "match"),
    [
        ({"sag_spacing_mm": [1.0, 1.0]}, "no heights"),
        ({"sag_mm": [[0.0] * 4] * 4}, "needs sag_spacing_mm"),
        ({"sag_mm": [[0.0] * 4] * 3 + [[0.0]], "sag_spacing_mm": [1.0, 1.0]}, "not equally long"),
        ({"sag_mm": [[0.0] * 4] * 4, "sag_spacing_mm": [1.0, 0.0]}, "must be positive"),
        ({"sag_file": "a.csv", "even_asphere": [1.0]}, "choose one"),
        ({"gradient_radial": [-1e-3]}, "index, to which its gradient adds"),
        ({"gradient_axial": [-1e-3], "glass": 1.5, "gradient_step_mm": 0.0}, "greater than 0"),
    ],
)
def test_bad_keys_are_refused(surface, match):
    with pytest.raises(ValidationError, match=match):
        SystemSection.model_validate(section(surface))


def test_several_arrays_and_no_path_are_refused(tmp_path):
    np.savez(tmp_path / "sag.npz", HEIGHTS)
    (tmp_path / "sag.npz").rename(tmp_path / "sag.npy")
    with pytest.raises(UserError, match="holds several arrays"):
        read_sag(tmp_path / "sag.npy")
    with pytest.raises(UserError, match="must be the path of a file"):
        read_sag(3)


def test_a_spacing_is_given_once(tmp_path):
    dat(tmp_path / "sag.dat", HEIGHTS, "6 5 2.0 3.0 0 0 0")
    with pytest.raises(UserError, match="leave out sag_spacing_mm"):
        record(tmp_path, {"sag_file": "sag.dat", "sag_spacing_mm": [1.0, 1.0]})
    np.save(tmp_path / "sag.npy", HEIGHTS)
    with pytest.raises(UserError, match="needs sag_spacing_mm"):
        build(SystemSection.model_validate(section({"sag_file": str(tmp_path / "sag.npy")})))


def test_a_rod_of_varying_index_in_a_table():
    """f = 1 / (n0 g sin g L) with g = 0.05 per mm: n^2 = 2.56 (1 - g^2 r^2)."""
    from wavequake.optics.systems.paraxial import paraxial

    rod = {
        "entrance_diameter_mm": 1.0,
        "wavelengths_nm": [550.0],
        "surface": [
            {"name": "front", "glass": 1.6, "gradient_radial": [-2.56 * 0.05**2], "stop": True},
            {"name": "rear", "distance_mm": 20.0, "glass": "air"},
            {"name": "image", "distance_mm": 8.0},
        ],
    }
    system = build(SystemSection.model_validate(rod))
    assert paraxial(system).focal_length == pytest.approx(1 / (1.6 * 0.05 * np.sin(1.0)), rel=1e-12)
