"""Media with a gradient in lens files (.zmx), against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Moving, Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.agf import parse_rods
from wavequake.optics.media.glasses import AIR, constant, glass
from wavequake.optics.media.gradients import GradientIndex, axial, luneburg, medium_index, selfoc
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

N0, G = 1.6, 0.05


def file(first, length, *rows, unit="MM"):
    """A rod of the length whose first surface has these lines, and surfaces behind it."""
    surfaces = ["  DISZ INFINITY", f"  {first}\n  STOP\n  DISZ {length!r}", *rows, "  DISZ 0", "  DISZ 0"]
    head = f"UNIT {unit} X W\nENPD 0.1\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\n"
    return head + "\n".join(f"SURF {i}\n{row}" for i, row in enumerate(surfaces)) + "\n"


def parameters(kind, *numbers):
    return "\n  ".join([f"TYPE {kind}", *(f"PARM {k} {v!r}" for k, v in enumerate(numbers, start=1))])


def bundle(x, u=0.0):
    x, u = np.broadcast_arrays(np.atleast_1d(x), u)
    direction = np.stack([u, 0 * x, np.sqrt(1 - u**2)])
    return Rays(np.stack([x, 0.3 * x, 0 * x]), direction, np.zeros(x.shape))


def trace(optics, rays):
    return trace_sequence_numpy(pack(optics, 550e-6), rays, moving(optics, rest_states(optics)))


@pytest.mark.parametrize(("unit", "mm"), [("MM", 1.0), ("IN", 25.4)])
def test_a_quarter_pitch_rod_focuses_parallel_light_on_its_rear_face(unit, mm):
    """n² = n0² (1 - g² r²): a ray crosses the axis at a quarter of its own pitch, pi T_z / (2 n0 g)."""
    g = G * mm  # per unit of the file
    rod = file(parameters("GRINSUR2", 1.0, N0**2, -((N0 * g) ** 2)), np.pi / 2 / g, unit=unit)
    optics = parse_zmx(rod, "rod.zmx")
    assert optics.surfaces[0].medium == replace(
        selfoc(N0, G), name="gradient", radial=pytest.approx([-0.0064])
    )
    heights = np.array([1e-3, 1e-2, 2.0])
    traced = trace(optics, bundle(heights))
    assert (traced.status == OK).all()
    # The wave number across, n0 g, is the same for all; the way takes longer where the index is lower.
    r2 = 1.09 * heights**2
    t = np.pi / 2 / G / (N0 * np.sqrt(1 - G**2 * r2))
    np.testing.assert_allclose(traced.x[0], heights * np.cos(N0 * G * t), rtol=0, atol=2e-10)
    np.testing.assert_allclose(traced.u[0], -heights * N0 * G * np.sin(N0 * G * t), rtol=0, atol=2e-10)
    assert paraxial(optics).focal_length == pytest.approx(1 / (N0 * G), rel=1e-12)


@pytest.mark.parametrize("kind", ["GRINSUR1", "GRINSUR3", "GRINSUR5"])
def test_the_quadratic_term_of_the_index_makes_the_focal_length_of_a_rod(kind):
    """n = n0 (1 - A r² / 2): f = 1 / (n0 sqrt A sin(L sqrt A)), as makers of rod lenses print it."""
    a, length = 0.01, 9.0
    optics = parse_zmx(file(parameters(kind, 0.1, N0, -N0 * a / 2), length), "rod.zmx")
    assert paraxial(optics).focal_length == pytest.approx(1 / (N0 * np.sqrt(a) * np.sin(length * np.sqrt(a))))


@pytest.mark.parametrize(("kind", "before"), [("GRINSUR3", (0.0, 0.0, 0.0)), ("GRINSUR5", (0.0, 0.0))])
def test_an_index_that_grows_along_the_axis_bends_rays_to_it(kind, before):
    """n = n0 + a z keeps n sin(angle) = p; x = (p / a) (acosh(n1 / p) - acosh(n0 / p)) over the length."""
    a, length = 0.02, 12.0
    optics = parse_zmx(file(parameters(kind, 0.1, 1.5, *before, a), length), "rod.zmx")
    assert optics.surfaces[0].medium.axial == pytest.approx([2 * 1.5 * a, a**2])
    p = np.array([0.05, 0.3, 0.6])
    traced = trace(optics, bundle(np.zeros(3), p))
    shift = p / a * (np.arccosh((1.5 + a * length) / p) - np.arccosh(1.5 / p))
    np.testing.assert_allclose(traced.x[0], shift, rtol=0, atol=1e-9)
    np.testing.assert_allclose(traced.u[0], p, rtol=0, atol=1e-12)


def test_every_power_has_its_place():
    def medium(*numbers):
        return parse_zmx(file(parameters(*numbers), 1.0), "rod.zmx").surfaces[0].medium

    r2, z = np.array([0.0, 0.5, 2.0]), np.array([0.0, 0.7, 3.0])

    def squared(one, across, along):
        both = [
            sum(c * x ** (k + 1) for k, c in enumerate(cs))
            for cs, x in ((one.radial, across), (one.axial, along))
        ]
        return one.base.coefficients[0] ** 2 + both[0] + both[1]

    two = medium("GRINSUR2", 0.1, 2.25, 1e-2, 2e-3, 3e-4, 4e-5, 5e-6, 6e-7)
    assert two.base == constant(1.5)
    assert two.radial == (1e-2, 2e-3, 3e-4, 4e-5, 5e-6, 6e-7)
    three = medium("GRINSUR3", 0.1, 1.5, 1e-2, 2e-3, 3e-4)
    np.testing.assert_allclose(
        squared(three, r2, 0 * z), (1.5 + 1e-2 * r2 + 2e-3 * r2**2 + 3e-4 * r2**3) ** 2
    )
    three = medium("GRINSUR3", 0.1, 1.5, 0.0, 0.0, 0.0, 1e-2, 2e-3, 3e-4)
    np.testing.assert_allclose(squared(three, 0 * r2, z), (1.5 + 1e-2 * z + 2e-3 * z**2 + 3e-4 * z**3) ** 2)
    five = medium("GRINSUR5", 0.1, 1.5, 1e-2, 2e-3)
    np.testing.assert_allclose(squared(five, r2, 0 * z), (1.5 + 1e-2 * r2 + 2e-3 * r2**2) ** 2)
    five = medium("GRINSUR5", 0.1, 1.5, 0.0, 0.0, 1e-2, 2e-3, 3e-4, 4e-5)
    np.testing.assert_allclose(
        squared(five, 0 * r2, z), (1.5 + 1e-2 * z + 2e-3 * z**2 + 3e-4 * z**3 + 4e-5 * z**4) ** 2
    )
    assert medium("GRINSUR2", 0.1, 2.25) == constant(1.5)  # no coefficient, no gradient


def rod(medium, rows=(), **keys):
    rows = [
        SurfaceRow("front", Conic(40.0, -0.5), 6.0, "refract", medium, Opening(3.0)),
        *rows,
        SurfaceRow("rear", Conic(-60.0), 5.0, "refract", AIR),
        SurfaceRow("image"),
    ]
    return OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 4.0), **keys)


small = st.floats(-1e-3, 1e-3).filter(lambda value: abs(value) > 1e-9)
media = st.one_of(
    st.tuples(st.floats(1.2, 3.0), st.lists(small, min_size=1, max_size=6)).map(
        lambda numbers: GradientIndex("gradient", constant(numbers[0]), tuple(numbers[1]))
    ),
    st.tuples(st.floats(1.2, 3.0), st.lists(small, min_size=1, max_size=3)).map(
        lambda numbers: axial((numbers[0], *numbers[1]))
    ),
)


@settings(max_examples=60, deadline=None)
@given(media)
def test_what_is_written_is_read_back(medium):
    """Of n² to the bit, of n = n0 + a z + ... to rounding: its square is written by its root."""
    again = parse_zmx(zmx_text(rod(medium)), "rod.zmx").surfaces[0].medium
    assert again.base == medium.base
    assert again.radial == medium.radial
    z = 3.0
    sizes = [abs(c) * z**k for k, c in enumerate(medium.axial, start=1)]
    for k, (ours, theirs) in enumerate(zip(medium.axial, again.axial, strict=False), start=1):
        assert theirs * z**k == pytest.approx(ours * z**k, abs=1e-15 * (1 + max(sizes)))


def test_a_stop_inside_a_rod_tells_its_medium_again():
    inside = rod(selfoc(N0, G), [SurfaceRow("stop", Conic(), 7.0, opening=Opening(2.5))])
    inside = replace(inside, stop=1, fields=np.array([[0.0, 0.05]]))
    again = parse_zmx(zmx_text(inside), "rod.zmx")
    rays = bundle(np.linspace(-2, 2, 9), 0.02)
    ours, theirs = trace(inside, rays), trace(again, rays)
    np.testing.assert_array_equal(theirs.status, ours.status)
    for key in ("x", "y", "u", "path"):
        np.testing.assert_allclose(getattr(theirs, key), getattr(ours, key), rtol=0, atol=1e-9)


def turned(system, index, **changes):
    surfaces = list(system.surfaces)
    surfaces[index] = replace(surfaces[index], **changes)
    return replace(system, surfaces=tuple(surfaces))


STOP_INSIDE = SurfaceRow("stop", Conic(), 7.0)


@pytest.mark.parametrize(
    ("system", "match"),
    [
        (rod(luneburg(10.0)), "is neither n² = n0²"),
        (rod(GradientIndex("seven", constant(1.5), (0.0,) * 6 + (1e-9,))), "seven behind front is neither"),
        (rod(axial((1.5, 1e-3, 1e-4, 1e-5, 1e-5))), "axial gradient behind front is neither"),
        (rod(GradientIndex("odd", constant(1.5), (), (1e-3,))), "odd behind front is neither"),
        (rod(GradientIndex("glass", glass("F2"), (-1e-3,))), "a gradient and dispersion"),
        (rod(GradientIndex("bad", constant(1.5), (np.nan,))), "finite numbers only"),
        (
            rod(axial((1.5, 1e-3)), [STOP_INSIDE]),
            "stop stands in axial gradient, whose",
        ),
        (turned(rod(selfoc(N0, G), [STOP_INSIDE]), 1, position=np.array([0.1, 0, 6])), "stands in SELFOC"),
        (
            turned(rod(selfoc(N0, G), [STOP_INSIDE]), 1, rotation=cardan(np.array([0.1, 0, 0]))),
            "stands in SELFOC",
        ),
        (
            turned(rod(selfoc(N0, G)), 0, shape=EvenAsphere(50.0, 0.0, (1e-3,))),
            "a plane, a sphere or a conic",
        ),
        (rod(selfoc(N0, G), [SurfaceRow("flat", Conic(), -6.0, "reflect")]), "mirror flat stands in SELFOC"),
    ],
)
def test_media_that_the_format_has_not_are_refused_by_name(system, match):
    with pytest.raises(UserError, match=match):
        zmx_text(system)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (
            file(parameters("GRINSUR1", 1.0, 1.5, -1e-3, 0.01), 5.0),
            "parameter 4 of the type GRINSUR1",
        ),
        (file(parameters("GRINSUR5", 1.0, 1.5, *[0.0] * 6, 0.1), 5.0), "parameter 9 of the type GRINSUR5"),
        (file(parameters("GRINSUR3", 1.0, 1.5, 1e-3, 0.0, 0.0, 1e-3), 5.0), "along and across the axis"),
        (file(parameters("GRINSUR2", 1.0, -2.25, 1e-3), 5.0), "index n0 = -2.25 .parameter 2., not positive"),
        (file(parameters("GRINSUR2"), 5.0), "n0 = 0 .*not positive"),
        (file(parameters("GRINSUR5", 1.0, 1.5, 1e-3) + "\n  GLAS G14 0 0", 5.0), "a named material"),
        (
            file(parameters("GRINSUR2", 1.0, 2.25, 1e-3), 5.0, "  DISZ -5\n  GLAS MIRROR"),
            "mirror inside a medium whose index varies",
        ),
        (
            file(parameters("GRINSUR2", 1.0, 2.25, 1e-3), 5.0)[: -len("SURF 3\n  DISZ 0\n")],
            "image of rod lies in the medium .* whose index varies",
        ),
        (file(parameters("GRINSUR4", 1.0, 1.5), 5.0), "GRINSUR4, which is not supported"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(text, match):
    with pytest.raises(UserError, match=match):
        parse_zmx(text, "rod.zmx")


def test_the_surface_behind_which_a_medium_begins_keeps_its_shape_and_place():
    tilted = turned(
        rod(selfoc(N0, G)), 0, position=np.array([0.2, 0, 0]), rotation=cardan(np.array([0.1, 0.2, 0]))
    )
    again = parse_zmx(zmx_text(tilted), "rod.zmx").surfaces
    assert again[0].shape == Conic(40.0, -0.5)
    np.testing.assert_allclose(again[0].rotation, tilted.surfaces[0].rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(again[1].position, tilted.surfaces[1].position, rtol=0, atol=1e-12)


RODS = "TEST-ROD\n1.55\n0.0064\n0.4\n0.007\n0.0004\n"
ROD_FILE = file("TYPE GRINSUR9\n  PARM 1 1.0\n  GLAS TEST-ROD 0 0 1.5 40 0 0", 20.0)


def rod_numbers(um):
    """n0 and g by the maker's formula."""
    return 1.55 + 0.0064 / um**2, 0.4 + 0.007 / um**2 + 0.0004 / um**4


@pytest.mark.parametrize("um", [0.45, 0.9])
def test_a_rod_of_a_maker_follows_its_formula_at_every_wavelength(um):
    optics = parse_zmx(ROD_FILE, "rod.zmx", parse_rods(RODS, "rods.dat"))
    n0, g = rod_numbers(um)
    assert medium_index(optics.surfaces[0].medium, um * 1e-3) == pytest.approx(n0, rel=1e-15)
    # n = n0 (1 - g² r² / 2): in a plane with the axis n(r) cos(angle) is kept, and dr/dz follows.
    rays = bundle([0.3], 0.0)
    rays.position[1] = 0.0
    sequence, rest = pack(optics, um * 1e-3), moving(optics, rest_states(optics))
    traced = trace_sequence_numpy(
        replace(sequence, elements=sequence.elements[:2]), rays, Moving(rest.poses[:, :2])
    )

    def index(r):
        return n0 * (1.0 - g**2 * r**2 / 2.0)

    kept = index(0.3)

    def rates(_, state):
        r, p, _ = state
        return [p / kept, -index(r) * n0 * g**2 * r / kept, index(r) ** 2 / kept]

    end = solve_ivp(rates, (0.0, 20.0), [0.3, 0.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    assert traced.x[0, 0] == pytest.approx(end[0], abs=1e-10)
    assert traced.path[0, 0] == pytest.approx(end[2], abs=1e-9)


def test_the_focal_length_of_a_rod_is_that_of_its_color():
    optics = parse_zmx(ROD_FILE, "rod.zmx", parse_rods(RODS, "rods.dat"))
    for um in (0.45, 0.9):
        n0, g = rod_numbers(um)
        assert paraxial(optics, um * 1e-3).focal_length == pytest.approx(1.0 / (n0 * g * np.sin(g * 20.0)))


@pytest.mark.parametrize(
    ("text", "own", "why"),
    [
        (ROD_FILE, {}, "GRADIENT_9.DAT"),
        (ROD_FILE, {"TEST-ROD": constant(1.5)}, "a glass without a gradient"),
        (ROD_FILE.replace("UNIT MM", "UNIT IN"), parse_rods(RODS, "rods.dat"), "a file in mm"),
        (ROD_FILE.replace("PARM 1 1.0", "PARM 2 0.1"), parse_rods(RODS, "rods.dat"), "must be 0"),
    ],
)
def test_a_rod_that_is_not_known_is_refused(text, own, why):
    with pytest.raises(UserError, match=why):
        parse_zmx(text, "rod.zmx", own)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "holds no material"),
        ("A\n1\n2\n", "five lines"),
        (RODS + RODS.lower(), "rods.dat, line 7: there is a rod test-rod before"),
        (RODS.replace("0.4", "1e200"), "rods.dat, line 4: '1e200' is no number of a rod"),
    ],
)
def test_files_of_rods_need_six_lines_each(text, why):
    with pytest.raises(UserError, match=why):
        parse_rods(text, "rods.dat")
