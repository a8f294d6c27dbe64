"""Grids of heights that do not cover what the light fills of their surfaces."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake import load_study
from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.grid_cover import require_cover
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic, GridSag, Opening
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.workflows.run import run
from wavequake.workflows.systems.bench import system_bench


def mirror(half, opening=None, field=0.0, stop_before=0.0):
    """A flat mirror with a grid of 5 x 9 nodes that reaches to x and y, behind a stop of 20 mm."""
    heights = np.arange(45.0).reshape(5, 9) * 1e-6
    grid = GridSag(np.inf, 0.0, heights, half[0] / 4.0, half[1] / 2.0)
    rows = [
        SurfaceRow("stop", thickness=stop_before),
        SurfaceRow("M1", grid, thickness=-100.0, action="reflect", opening=opening),
        SurfaceRow("image"),
    ]
    fields = np.array([[0.0, 0.0], [0.0, field]])
    return OpticalSystem("flat", sequential(rows), 0, Pupil("entrance_diameter", 20.0), fields=fields)


@given(st.floats(10.01, 500.0), st.floats(10.01, 500.0), st.floats(1.0, 7.99), st.booleans())
def test_the_beam_must_lie_within_the_nodes(x, y, less, along_x):
    require_cover(mirror((x, y)))
    short = (less, y) if along_x else (x, less)
    with pytest.raises(
        UserError, match=r"'M1' reaches to x = .* mm, the beams of all fields to 10 and 10 mm"
    ):
        require_cover(mirror(short))


def test_the_nodes_may_end_half_a_step_inside_the_rim_of_the_beam():
    """As those at the centers of pixels do: of 9 and 5 nodes, an eighth and a quarter of their half width."""
    require_cover(mirror((10.0 / 1.125, 10.0 / 1.25)))


def test_fields_move_the_beam_along_the_surface():
    require_cover(mirror((10.01, 10.01 + 0.1 * 50.0), field=np.arctan(0.1), stop_before=50.0))
    with pytest.raises(UserError, match="to 10 and 15 mm"):
        require_cover(mirror((10.01, 11.9), field=np.arctan(0.1), stop_before=50.0))


def test_what_an_opening_stops_needs_no_heights():
    require_cover(mirror((5.0, 5.0), Opening(5.0)))
    require_cover(mirror((5.0, 6.5), Opening(5.0, center=(0.0, 1.5))))
    require_cover(mirror((3.0, 4.0), Opening(corners=((-3.0, -4.0), (3.0, -4.0), (0.0, 4.0)))))
    with pytest.raises(UserError, match=r"to 5 and 6\.5 mm"):
        require_cover(mirror((5.0, 5.1), Opening(5.0, center=(0.0, 1.5))))


def test_a_system_without_grids_needs_none():
    plain = mirror((1.0, 1.0))
    surfaces = (plain.surfaces[0], replace(plain.surfaces[1], shape=Conic()), plain.surfaces[2])
    require_cover(replace(plain, surfaces=surfaces))


def test_info_says_what_is_not_covered():
    assert "grid of heights of 'M1' reaches to x = 4 and y = 10 mm" in info(mirror((4.0, 10.0)))
    assert "grid of heights" not in info(mirror((10.0, 10.0)))


def test_beyond_a_grid_the_heights_of_its_edge_go_on():
    """As docs/systems.md says: a plane beside the corner reflects straight back, from the corner's height."""
    system = mirror((4.0, 4.0))
    x, y = np.array([4.0, 6.0, 9.0, 4.5]), np.array([-4.0, -5.0, -9.9, -4.1])
    rays = Rays(np.array([x, y, np.full(4, -50.0)]), np.tile([[0.0], [0.0], [1.0]], 4), np.zeros(4))
    traced = trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)))
    np.testing.assert_allclose(traced.x[0, 1:], x[1:], atol=1e-13)
    np.testing.assert_allclose(traced.y[0, 1:], y[1:], atol=1e-13)
    sag, along_x, along_y = shape_sag(system.surfaces[1].shape, x, y)
    np.testing.assert_allclose(sag, 8e-6, rtol=1e-12)
    assert not along_x[1:].any()
    assert not along_y[1:].any()


def test_a_study_with_spacings_in_another_unit_is_refused(tmp_path):
    np.save(tmp_path / "sag.npy", np.zeros((17, 17)))
    text = """
[study]
name = "flat"
workflow = "system-disturbance"
[system]
entrance_diameter_mm = 200.0
wavelengths_nm = [550.0]
[[system.surface]]
name = "M1"
radius_mm = -2000.0
glass = "mirror"
stop = true
sag_file = "sag.npy"
sag_spacing_mm = [SPACING, SPACING]
[[system.surface]]
name = "image"
distance_mm = 1000.0
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["M1"]
instants = 4
lines = [{ frequency_hz = 85.0, amplitude = { dy_um = 3.0 } }]
"""
    path = tmp_path / "study.toml"
    path.write_text(text.replace("SPACING", "1.0"))
    with pytest.raises(UserError, match=r"'M1' reaches to x = 8 .* to 100 and 100 mm; it must cover them"):
        run(load_study(path), store=tmp_path / "store")
    path.write_text(text.replace("SPACING", "12.5"))
    assert system_bench(load_study(path).identity_text()).system.surfaces[0].name == "M1"
