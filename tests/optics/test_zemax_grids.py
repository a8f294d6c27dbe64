"""Heights on a grid in lens files (.zmx): Grid Sag."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic, GridSag
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx


def file(*lines, unit="MM"):
    first = "".join(f"\n  {line}" for line in lines)
    return (
        f"UNIT {unit} X W\nENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nSURF 0\n  DISZ INFINITY\n"
        f"SURF 1\n  TYPE GRID_SAG\n  STOP\n  GLAS MIRROR 0 0{first}\n  DISZ -100\nSURF 2\n  DISZ 0\n"
    )


def nodes(heights, first=1):
    """The lines of a grid without slopes, heights by rows from the lowest y."""
    rows = heights[::-1].ravel()
    return [f"GARR {k} {float(z)!r} 0 0 0 0" for k, z in enumerate(rows, start=first)]


def mirror(shape):
    rows = [SurfaceRow("M1", shape, -100.0, "reflect"), SurfaceRow("image")]
    return OpticalSystem("mirror", sequential(rows), 0, Pupil("entrance_diameter", 10.0))


def trace(system):
    x, y = np.random.default_rng(2).uniform(-5, 5, (2, 50))
    rays = Rays(np.stack([x, y, 0 * x - 20]), np.array([[0.0], [0.0], [1.0]]) * np.ones(50), np.zeros(50))
    return trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)))


@pytest.mark.parametrize(("first", "h"), [(0, 0.5), (1, 0.5), (1, 0.25)])
def test_a_sphere_given_as_a_grid_is_that_sphere(first, h):
    """A cubic spline misses slopes by h^3 / 24, heights by 5 h^4 / 384 of the fourth derivative, 3 / R^3."""
    x, y = np.meshgrid(h * (np.arange(61) - 30), h * (np.arange(51) - 25))
    sag = 200.0 - np.sqrt(200.0**2 - x**2 - y**2)
    system = parse_zmx(file(f"GDAT 61 51 {h} {h}", *nodes(sag, first)), "lens.zmx")
    found = trace(system)
    truth = trace(mirror(Conic(200.0)))
    fourth = 3 / 200.0**3
    slope, height = h**3 / 24 * fourth, 5 * h**4 / 384 * fourth
    np.testing.assert_allclose([found.x, found.y], [truth.x, truth.y], rtol=0, atol=2 * 100 * slope)
    x, y = np.random.default_rng(4).uniform(-5, 5, (2, 100))
    sag = 200.0 - np.sqrt(200.0**2 - x**2 - y**2)
    np.testing.assert_allclose(shape_sag(system.surfaces[0].shape, x, y)[0], sag, rtol=0, atol=2 * height)


@pytest.mark.parametrize(("unit", "mm"), [("MM", 1.0), ("CM", 10.0)])
def test_nodes_run_along_x_from_the_upper_left(unit, mm):
    """Heights a x + b y^2 x on 6 columns and 5 rows, on a conic base."""
    x, y = np.meshgrid(2.0 * (np.arange(6) - 2.5), 3.0 * (np.arange(5) - 2))
    lines = ["CURV 0.01", "CONI -1", "PARM 0 0", "GDAT 6 5 2 -3 0 0 0", *nodes(1e-3 * x + 1e-5 * y**2 * x)]
    shape = parse_zmx(file(*lines, unit=unit), "lens.zmx").surfaces[0].shape
    assert (shape.radius, shape.conic, shape.dx, shape.dy) == (100 * mm, -1.0, 2 * mm, 3 * mm)
    at_x, at_y = np.array([1.3, -4.0, 0.2]), np.array([2.0, -5.5, 0.7])
    expected = (at_x**2 + at_y**2) / 200 + 1e-3 * at_x + 1e-5 * at_y**2 * at_x
    np.testing.assert_allclose(shape_sag(shape, mm * at_x, mm * at_y)[0], mm * expected, rtol=1e-12)


@pytest.mark.parametrize(("unit", "mm"), [("MM", 1.0), ("CM", 10.0)])
def test_an_even_asphere_and_zernike_polynomials_lie_below_a_grid(unit, mm):
    """Zernike Standard 4 is sqrt(3) (2 r^2 / R^2 - 1)."""
    x, _ = np.meshgrid(np.arange(6) - 2.5, np.arange(5) - 2.0)
    more = ["PARM 1 1e-4", "PARM 3 2e-6", "XDAT 1 4 0 0", "XDAT 2 5 0 0", "XDAT 6 0.01 0 0"]
    lines = ["CURV 0.01", "CONI -1", "PARM 0 0", *more, "GDAT 6 5 1 1 0 0 0", *nodes(1e-3 * x)]
    shape = parse_zmx(file(*lines, unit=unit), "lens.zmx").surfaces[0].shape
    at_x, at_y = np.array([1.3, -2.0, 0.2]), np.array([1.0, -1.5, 0.7])
    square = at_x**2 + at_y**2
    expected = square / 200 + 1e-4 * square + 2e-6 * square**3 + 1e-3 * at_x
    expected += 0.01 * np.sqrt(3.0) * (2.0 * square / 25.0 - 1.0)
    np.testing.assert_allclose(shape_sag(shape, mm * at_x, mm * at_y)[0], mm * expected, rtol=1e-12)


def rough(rows=9, columns=7):
    heights = np.random.default_rng(5).normal(0, 1e-3, (rows, columns))
    return GridSag(-150.0, -0.4, heights, 2.0, 1.5)


def test_what_is_written_is_read_back():
    system = mirror(rough())
    again = parse_zmx(zmx_text(system), "lens.zmx").surfaces[0].shape
    np.testing.assert_array_equal(again.heights, rough().heights)
    assert (again.radius, again.conic, again.dx, again.dy) == (-150.0, -0.4, 2.0, 1.5)


def hermite(t):
    """The cubics that have value and slope at 0 and at 1."""
    return np.array([(1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2, t * t * (3 - 2 * t), t * t * (t - 1)])


def test_the_written_slopes_make_the_same_surface_between_the_nodes():
    """A bicubic patch of the four numbers at its corners is the spline that is traced."""
    shape = rough()
    rows, columns = shape.heights.shape
    lines = [line.split() for line in zmx_text(mirror(shape)).splitlines() if line.strip().startswith("GARR")]
    value, by_x, by_y, by_xy = np.array([line[2:] for line in lines], float).T.reshape(4, rows, columns)[
        :, ::-1
    ]
    rng = np.random.default_rng(1)
    i, j, s, t = (*rng.integers(0, [[rows - 1], [columns - 1]], (2, 60)), *rng.uniform(0, 1, (2, 60)))
    along_y, along_x = hermite(s), hermite(t)
    patch = 0.0
    for a in (0, 1):
        for b in (0, 1):
            corner = (i + a, j + b)
            patch += along_y[2 * a] * along_x[2 * b] * value[corner]
            patch += along_y[2 * a] * along_x[2 * b + 1] * shape.dx * by_x[corner]
            patch += along_y[2 * a + 1] * along_x[2 * b] * shape.dy * by_y[corner]
            patch += along_y[2 * a + 1] * along_x[2 * b + 1] * shape.dx * shape.dy * by_xy[corner]
    x, y = shape.dx * (j + t - (columns - 1) / 2), shape.dy * (i + s - (rows - 1) / 2)
    truth = shape_sag(shape, x, y)[0] - shape_sag(Conic(shape.radius, shape.conic), x, y)[0]
    np.testing.assert_allclose(patch, truth, rtol=0, atol=1e-15)


FLAT = np.zeros((5, 5))
HOLE = [*nodes(FLAT)[:-1], "GARR 25 0 0 0 0 1"]


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        ([], "surface 1 has no grid .GDAT and GARR."),
        (["GDAT 5 5 1 1 0 0.5 0", *nodes(FLAT)], "decentered or in other units"),
        (["GDAT 4 5 1 1", *nodes(FLAT[:4])], "4 nodes along an axis; 5 to .* are possible"),
        (["GDAT 5 5 1 1", *nodes(FLAT)[:-1]], "announces 25 nodes .*, 24 lines GARR follow"),
        (["GDAT 5 5 1 1", *nodes(FLAT)[:-1], "GARR 3 0 0 0 0 0"], "announces 25 nodes"),
        (["GDAT 5 5 1 1", *nodes(FLAT, 2)], "announces 25 nodes"),
        (["GDAT 5 5 1 1"], "announces 25 nodes"),
        (["GDAT 5 5 1 1", *HOLE], r"line \d+ .GARR.: surface 1 has a node without data"),
        (["GDAT 5 5 0 1", *nodes(FLAT)], "spacings of a grid are 0.0 and 1.0"),
        (["GDAT 5 5 nan 1", *nodes(FLAT)], "not a finite number"),
        (["PARM 0 1", "GDAT 5 5 1 1", *nodes(FLAT)], "interpolated linearly"),
        (["PARM 9 1e-6", "GDAT 5 5 1 1", *nodes(FLAT)], "parameter 9 of the type GRID_SAG must be 0"),
        (["XDAT 1 4", "XDAT 6 0.1", "GDAT 5 5 1 1", *nodes(FLAT)], "positive normalization radius .XDAT 2"),
        (["GDAT 40000 40000 1 1", *nodes(FLAT)], "announces 1600000000 nodes"),
    ],
)
def test_grids_that_are_not_supported_are_refused_by_name(lines, match):
    with pytest.raises(UserError, match=match):
        parse_zmx(file(*lines), "lens.zmx")


def test_a_grid_in_a_standard_surface_is_not_left_out():
    text = file("GDAT 5 5 1 1", *nodes(FLAT)).replace("TYPE GRID_SAG", "TYPE STANDARD")
    with pytest.raises(UserError, match="GDAT"):
        parse_zmx(text, "lens.zmx")
