"""What a file outside the package adds: a method of reduction, by a call or by an entry point."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from small_mirrors import MOR

from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.reduction.method import METHODS, Method, NormalModes, register
from wavequake.reduction.metrics import pseudo_frequencies, receptance
from wavequake.reduction.names import parse
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import elastic_flexibility
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

OWN = """
import numpy as np
from wavequake.reduction.method import Method, register
from wavequake.reduction.structure import elastic_flexibility

def ritz(body, variant, count):
    return elastic_flexibility(body)(body.inputs)[:, :count]

register(Method("ritz", ritz))
"""


def ritz(body, variant, count):
    """Responses to forces at the interface and to their inertia forces (Wilson, Yuan and Dickens 1982)."""
    solve = elastic_flexibility(body)
    blocks = [solve(body.inputs)]
    while len(blocks) * len(body.interface) < count:
        block = solve(body.mass @ blocks[-1])
        blocks.append(block / np.abs(block).max(axis=0))
    return np.hstack(blocks)[:, :count]


@pytest.fixture(scope="module")
def mirror():
    return circular_mirror(CircularMirror(core=3, rings=3))


@pytest.fixture
def own():
    yield register(Method("ritz", ritz))
    del METHODS.known()["ritz"]


def test_an_own_method_reduces(own, mirror):
    """Two blocks of load-dependent vectors span the moments about 0 Hz."""
    small, krylov = reduce(mirror, "ritz24"), reduce(mirror, "krylov(0*2)")
    assert (small.name, small.method, small.order) == ("ritz24", "ritz", 24)
    assert pseudo_frequencies(small) == pytest.approx(pseudo_frequencies(krylov), rel=1e-6)
    frequencies = [20.0, 200.0, 900.0]
    assert receptance(small, frequencies) == pytest.approx(receptance(krylov, frequencies), rel=1e-6)


@pytest.mark.usefixtures("mirror_models")
def test_an_own_method_is_a_variant_of_a_study(own, tmp_path):
    study = load_study("mirror-mor", MOR | {"reduction.variants": ["ritz24", "krylov(0*2)"]})
    run_study(study, tmp_path / "store", on="serial")
    store = open_store(tmp_path / "store").load()
    assert [str(name) for name in store["method"].values] == ["full", "ritz", "krylov"]
    errors = store["eps_mech"].values
    assert errors[1] == pytest.approx(errors[2], rel=1e-5)
    assert errors[1].max() > 1e-3
    with pytest.raises(UserError, match=r"no reduction method 'rits' .* nearest one is 'ritz'"):
        load_study("mirror-mor", MOR | {"reduction.variants": ["rits24"]})


def test_an_own_method_is_limited_as_those_of_the_package(own, mirror):
    with pytest.raises(UserError, match="takes no arguments"):
        parse("ritz24(150)")
    with pytest.raises(UserError, match="above 6, the number of rigid motions"):
        reduce(mirror, "ritz6")
    register(replace(own, modes=NormalModes(static=lambda size: 12, kind="load-dependent")))
    with pytest.raises(UserError, match="below the 12 rigid motions and load-dependent modes"):
        reduce(mirror, "ritz9")


def test_names_clash_in_one_sentence(own):
    with pytest.raises(UserError, match=r"called 'craigb', in .*component_modes and in"):
        register(Method("craigb", ritz))
    with pytest.raises(UserError, match="'ritz2' of a reduction method must be of small letters"):
        register(Method("ritz2", ritz))


def test_an_installed_distribution_adds_a_method(tmp_path):
    (tmp_path / "own_ritz.py").write_text(OWN)
    info = tmp_path / "own_ritz-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-ritz\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[wavequake.methods]\nritz = own_ritz\n")
    path = os.pathsep.join([str(tmp_path), *(part for part in sys.path if part)])
    done = subprocess.run(
        [sys.executable, "-c", "from wavequake.reduction.names import parse; print(parse('ritz15'))"],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "ritz15"
