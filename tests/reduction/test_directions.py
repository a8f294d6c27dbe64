"""Which directions a basis keeps follows from the model, not from rounding, processor or way of reduction.

The mirror has threefold symmetry and nine inputs: orders cut pairs of equal modes and blocks of nine moments.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_array

from wavequake.reduction.directions import orthonormalize, turn_equal
from wavequake.reduction.intermediate import intermediate
from wavequake.reduction.methods.krylov import krylov
from wavequake.reduction.metrics import eps_mor, full_receptance, pseudo_frequencies, receptance
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import structure
from wavequake.reduction.two_stage import reduce_variants

FREQUENCIES = [61.0, 150.0, 431.0, 700.0, 1100.0]
# krylov: 30 and 24 of blocks of nine, at one point and at two; elastic modes 7, 21 and 27 are one of a pair.
CUTTING = (
    "krylov36(150)",
    "krylov30(100,300)",
    "krylov33(150+20j)",
    "rubin36",
    "rubin22",
    "modal27",
    "craigb25",
    "hintz28",
    "bt21",
    "irka21",
)


def values(full, variant):
    """Errors against the receptance of the full model, and the largest pseudo-eigenfrequency."""
    return np.append(eps_mor(full, receptance(variant, FREQUENCIES)), pseudo_frequencies(variant)[-1])


def perturbed(matrix, seed):
    noise = 1e-14 * np.random.default_rng(seed).standard_normal(matrix.nnz)
    noise = csc_array((noise * matrix.data, matrix.indices, matrix.indptr), shape=matrix.shape)
    return csc_array(matrix + (noise + noise.T) / 2)


@pytest.fixture(scope="module")
def mirrors(coarse_mirror, mirror_stage):
    """The mirror and one with noise: model, intermediate model, receptance."""
    noisy = replace(
        coarse_mirror, mass=perturbed(coarse_mirror.mass, 1), stiffness=perturbed(coarse_mirror.stiffness, 2)
    )
    stages = mirror_stage, intermediate(noisy)
    return [
        (model, stage, full_receptance(model, FREQUENCIES))
        for model, stage in zip((coarse_mirror, noisy), stages, strict=True)
    ]


# Below 1e-8 an error is the rounding of the full-size solutions that it is taken against.
def agree(first, second):
    assert second == pytest.approx(first, rel=2e-6, abs=1e-8)


@pytest.mark.parametrize("name", CUTTING)
def test_rounding_does_not_choose(name, mirrors):
    """Noise of 1e-14 in the matrices moves no number, and both ways of reduction are one model."""
    found = [
        values(full, variant)
        for model, stage, full in mirrors
        for variant in (reduce_variants(stage, [name])[0], reduce(model, name))
    ]
    for other in found[1:]:
        agree(found[0], other)


def test_another_kernel_of_blas_gives_the_same_errors(mirrors):
    names = ["krylov36(150)", "rubin36"]
    script = f"""
import json
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.reduction.metrics import pseudo_frequencies, receptance
from wavequake.reduction.reduce import reduce
model = circular_mirror(CircularMirror(core=3, rings=3))
for name in {names!r}:
    small = reduce(model, name)
    dynamic = receptance(small, {FREQUENCIES!r})
    print(json.dumps([dynamic.real.tolist(), dynamic.imag.tolist(), pseudo_frequencies(small)[-1]]))
"""
    environment = os.environ | {"OPENBLAS_CORETYPE": "Nehalem", "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    model, _, full = mirrors[0]
    for name, line in zip(names, run.stdout.splitlines(), strict=True):
        real, imaginary, highest = json.loads(line)
        found = np.append(eps_mor(full, np.array(real) + 1j * np.array(imaginary)), highest)
        agree(values(full, reduce(model, name)), found)


def test_a_cut_block_keeps_what_carries_most_of_its_moment(lattice):
    """No four directions leave less of the moment at 90 Hz in the norm of the mass (Eckart, Young)."""
    mass, stiffness = lattice.mass.toarray(), lattice.stiffness.toarray()
    moment = np.linalg.solve(stiffness - (2 * np.pi * 90.0) ** 2 * mass, lattice.inputs.toarray())
    root = np.sqrt(np.diag(mass))[:, None]
    rigid = np.linalg.qr(root * rigid_motions(lattice.nodes))[0]
    moment = root * moment - rigid @ (rigid.T @ (root * moment))
    kept = root * krylov(structure(lattice), 4, (90.0,), ())
    assert kept.T @ kept == pytest.approx(np.eye(4), abs=1e-12)
    left = np.linalg.norm(moment - kept @ (kept.T @ moment))
    assert left == pytest.approx(np.linalg.norm(np.linalg.svd(moment)[1][4:]), rel=1e-9)


def rigid_motions(nodes):
    turns = [np.cross(axis, nodes).ravel() for axis in np.eye(3)]
    return np.stack([*(np.tile(axis, len(nodes)) for axis in np.eye(3)), *turns], axis=1)


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_a_turned_pair_is_turned_back(seed):
    """Whatever the solver did with vectors of equal value, the result is one, up to signs."""
    random = np.random.default_rng(seed)
    numbers = np.array([1.0, 2.0, 2.0, 3.0, 5.0, 5.0, 5.0])
    vectors, rows = np.linalg.qr(random.standard_normal((9, 7)))[0], [0, 4, 7]
    turned = vectors.copy()
    turned[:, 1:3] = vectors[:, 1:3] @ np.linalg.qr(random.standard_normal((2, 2)))[0]
    turned[:, 4:] = vectors[:, 4:] @ np.linalg.qr(random.standard_normal((3, 3)))[0]
    plain, again = (turn_equal(numbers, one, one[rows]) for one in (vectors, turned))
    signs = np.sign(np.sum(plain * again, axis=0))
    assert again * signs == pytest.approx(plain, abs=1e-9)
    assert plain[:, [0, 3]] == pytest.approx(vectors[:, [0, 3]])


def test_directions_are_orthonormal_in_the_mass_and_leave_the_weak_ones_out():
    random = np.random.default_rng(4)
    mass = np.diag(random.uniform(1.0, 3.0, 12))
    first = orthonormalize(mass, random.standard_normal((12, 3)))
    vectors = np.hstack([first, random.standard_normal((12, 2)), 1e-6 * random.standard_normal((12, 1))])
    fine, coarse = (orthonormalize(mass, vectors, first, least) for least in (1e-8, 1e-4))
    assert (fine.shape[1], coarse.shape[1]) == (3, 2)
    assert fine.T @ mass @ fine == pytest.approx(np.eye(3), abs=1e-13)
    assert first.T @ mass @ fine == pytest.approx(0, abs=1e-13)
