"""What light shows of states of a telescope is traced once, and anew where anything of it is another."""

from dataclasses import replace

import numpy as np
import pytest
from wavefront_cases import sunflower_rays

from wavequake import tables
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.segments import at_rest
from wavequake.optics.segments.at_rest import traced_once
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.telescope import M2
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states


@pytest.fixture
def traces(monkeypatch, tmp_path):
    """How often anything was traced, with tables of this test alone."""
    monkeypatch.setattr(tables, "table_folder", lambda: tmp_path)
    calls = []
    monkeypatch.setattr(at_rest, "trace_states", lambda *given: calls.append(given) or trace_states(*given))
    return calls


def states_of(system):
    states = rest_states(system, TILE)
    bends = [None] * (M2) + [np.zeros((TILE, 6)) for _ in states.deformations[M2:-1]] + [None]
    return replace(states, deformations=tuple(bends))


def test_states_are_traced_once_and_anew_where_anything_is_another(traces):
    system = telescope("tmt-18")
    prepared = prepare(system, sunflower_rays(system), 550e-6, 15, mirror_terms=6)
    states = states_of(system)
    states.deformations[M2][3, 4] = 1e-5
    found = traced_once(prepared, states, ("text",))
    traced = trace_states(prepared, states, choose_device("numpy"))
    wanted = analyse(prepared, traced, chief_rays(prepared, states))
    np.testing.assert_array_equal(found[0], wanted.los)
    np.testing.assert_array_equal(found[1], wanted.zernike)
    again = traced_once(prepared, states, ("text",))
    assert len(traces) == 1
    np.testing.assert_array_equal(found[1], again[1])
    bent = states_of(system)
    bent.deformations[M2][3, 4] = 1.1e-5
    turned = states_of(system)
    turned.surface_motion[2, M2, 3] = 1e-9
    train = prepared.train
    moved = replace(prepared, train=replace(train, sphere_radius=train.sphere_radius * (1 + 1e-9)))
    for count, asked in enumerate(
        [
            (prepared, bent, ("text",)),
            (prepared, turned, ("text",)),
            (moved, states, ("text",)),
            (prepared, states, ("another",)),
        ]
    ):
        traced_once(*asked)
        assert len(traces) == 2 + count
    assert np.abs(traced_once(prepared, bent, ("text",))[1] - found[1]).max() > 1e-4
    assert len(traces) == 5
