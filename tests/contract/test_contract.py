"""What every study kind owes: with every source of motion, in every measure that it stores."""

import re
import sys

import numpy as np
import pytest
from small_kinds import KINDS
from study_text import controller, part
from test_sources import EXAMPLES, SEGMENTS, SYSTEM, entry, loaded

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.source import SOURCES
from wavequake.workflows.kinds import bundled_kinds, find_kind

pytestmark = pytest.mark.usefixtures("mirror_models")


def test_every_kind_is_in_the_table():
    assert set(KINDS) == set(bundled_kinds())


def test_workers_load_the_module_of_a_kind():
    for name in bundled_kinds():
        assert sys.modules[find_kind(name).module].KIND.name == name


def owes(template, arrays, cases):
    """Check the arrays of some cases against what their kind promises of each."""
    sizes = {}
    assert set(arrays) == set(template.per_case)
    for key, (dims, values, _) in template.fixed.items():
        for dim, size in zip(dims, np.shape(values), strict=True):
            assert sizes.setdefault(dim, size) == size, key
    for key, variable in template.per_case.items():
        assert variable.attrs["long_name"], key
        assert variable.dtype.startswith("int") or variable.attrs["units"], key
        for dim, size in zip(variable.dims, variable.shape, strict=True):
            assert sizes.setdefault(dim, size) == size, key
        values = arrays[key]
        assert values.shape == (cases, *variable.shape), key
        assert values.dtype == variable.dtype, key


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_gives_what_it_promises_and_a_case_does_not_depend_on_its_chunk(kept_stores, name):
    study_of, store_of = kept_stores
    study, store = study_of(name), store_of(name)
    whole, device = open_store(store).load(), read_manifest(store).device
    kind, text = find_kind(name), study.identity_text()
    last = study.cases - 1
    alone = kind.compute(text, np.array([last]), device)
    owes(kind.template(text), alone.arrays, 1)
    for key, variable in kind.template(text).per_case.items():
        if not variable.measured:
            np.testing.assert_array_equal(alone.arrays[key][0], whole[key][last].to_numpy(), err_msg=key)


STEERED = part("sensor", name="image", model="line-of-sight", rate_hz=50.0)
STEERED += controller("loop", "integrator", "image", "steer")
OPTIC = STEERED + part("actuator", name="steer", model="optic", of="surface 3", dofs=["rx", "ry"])
TILT = STEERED + part("actuator", name="steer", model="m2-rigid") + "[look]\ntraced = 2\n"
EXPOSED = SEGMENTS.replace("enabled = false", "pixels = 16")
# The optics that a kind disturbs, a study of it, and what is called NAME in the examples of sources.
DISTURBED = {
    "system-disturbance": ("surfaces", SYSTEM, "surface 3"),
    "system-loop": ("surfaces", SYSTEM + OPTIC, "surface 3"),
    "segment-disturbance": ("segments", SEGMENTS, "M2"),
    "telescope-exposure": ("segments", EXPOSED, "M2"),
    "telescope-loop": ("segments", EXPOSED + TILT, "M2"),
}


LEFT = "without light|pixels"  # what fails in a small frame: its image was moved out of it
# What a kind does not take, in words.
REFUSED = {
    "system-loop": {"creaking": "'creaking' is too fast for its loops"},
    "telescope-exposure": {"surface-deformation": "here M2 deforms to correct"},
}


@pytest.mark.parametrize("name", DISTURBED)
def test_every_source_that_fits_moves_every_measure_of_a_kind(tmp_path, name):
    """One study with a disturbance of each source that the kind takes; it says why it takes no other."""
    optics, text, element = DISTURBED[name]
    text = re.sub(r'workflow = ".*"', f'workflow = "{name}"', text)
    refused = REFUSED.get(name, {})

    def study_of(*models):
        entries = [entry(model, EXAMPLES[model], model) for model in models]
        return loaded(tmp_path, text, element, *entries, **{"campaign.cases": len(models)})

    models = [one for one in EXAMPLES if optics in SOURCES.entries()[one].fits and one not in refused]
    study, kind = study_of(*models), find_kind(name)
    identity, ids = study.identity_text(), np.arange(len(models))
    kind.check(identity)
    assert [*kind.case_table(identity, 0, len(ids))["disturbance"]] == models
    found = kind.compute(identity, ids, "numpy")
    assert not [said for said in found.messages if said and not re.search(LEFT, said)], found.messages
    assert np.mean(found.status == DONE) > 0.7
    owes(kind.template(identity), found.arrays, len(ids))
    alone = kind.compute(identity, ids[-1:], "numpy")
    for key, variable in kind.template(identity).per_case.items():
        if not variable.measured:
            np.testing.assert_array_equal(alone.arrays[key][0], found.arrays[key][-1], err_msg=key)
    for model, words in refused.items():
        with pytest.raises(UserError, match=words):
            kind.check(study_of(model).identity_text())
