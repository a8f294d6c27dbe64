import numpy as np
import pytest
import scipy.sparse

from wavequake.mechanics.level_factor import level_factor


def grid_matrix(rows, columns, seed=0):
    """A positive definite matrix of which each node of a grid couples to its four neighbors."""
    random = np.random.default_rng(seed)

    def path(size):
        return scipy.sparse.diags_array([np.ones(size - 1)] * 2, offsets=[-1, 1])

    one, two = scipy.sparse.eye_array(rows), scipy.sparse.eye_array(columns)
    pattern = scipy.sparse.kron(one, path(columns)) + scipy.sparse.kron(path(rows), two)
    pattern = scipy.sparse.coo_array(pattern)
    weights = scipy.sparse.coo_array((random.uniform(-1, 1, pattern.nnz), pattern.coords), pattern.shape)
    coupled = weights + weights.T
    return scipy.sparse.csr_array(coupled + scipy.sparse.diags_array(abs(coupled).sum(axis=1) + 0.5))


@pytest.mark.parametrize("apart", [False, True])
def test_solutions_are_those_of_the_whole_matrix(apart):
    matrix = grid_matrix(6, 9)
    if apart:  # parts of their own, one of them a single unknown, which lie between one another
        matrix = scipy.sparse.block_diag([matrix, [[2.0]], grid_matrix(3, 4, seed=1)]).tocsr()
        order = np.random.default_rng(1).permutation(matrix.shape[0])
        matrix = scipy.sparse.csr_array(matrix[order][:, order])
    factor = level_factor(matrix)
    assert len(factor.starts) == 14  # from corner to corner of the grid of 6 x 9
    right = np.random.default_rng(2).standard_normal((matrix.shape[0], 3))
    found = np.linalg.solve(matrix.toarray(), right)
    np.testing.assert_allclose(factor.solve(right), found, rtol=0, atol=1e-13 * np.abs(found).max())


def test_matrices_that_are_not_positive_definite_have_no_factor():
    matrix = grid_matrix(4, 5)
    with pytest.raises(np.linalg.LinAlgError):
        level_factor(scipy.sparse.csr_array(matrix - 10 * scipy.sparse.eye_array(20)))
