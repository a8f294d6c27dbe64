"""What stands behind the slashes of controllers' names, of a bundled study and of names that say nothing."""

from wavequake.workflows.loops.controller_names import explain_names
from wavequake.workflows.study import load_study


def test_names_of_varied_keys_are_explained():
    words = explain_names(one.model_dump() for one in load_study("structure-loop").controller)
    assert words == (
        "Behind the slashes of names: bandwidth_hz/latency_frames (tilt, figure), "
        "latency_frames (tilt-lqg, tilt-both, figure-lqg)."
    )


def test_slashes_that_no_key_explains_stay_unexplained():
    assert explain_names([{"name": "off"}]) == ""
    assert explain_names([{"name": "own/fast", "gain": 0.5}]) == ""
    assert explain_names([{"name": "own/1", "gain": 1.0, "latency_frames": 1.0}]) == ""  # of which key?
