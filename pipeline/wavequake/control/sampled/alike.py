"""Loops of many channels of which most are alike: the few directions that matter one by one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from wavequake.control.linear import Array, LinearModel

Complex = NDArray[np.complex128]
# A direction that matters less than this share of what is alike does not matter.
_ALIKE = 1e-9
# Channels below which nothing is gained.
_FEW = 6
# Singular values of what is not alike below this share are rounding.
_ROUNDED = 1e-12
# Frequencies that are computed together, to bound memory.
_BLOCK = 256


@dataclass(frozen=True)
class Parts:
    """B + sum over k of g_k into_k drives_k, of p channels, B = value 1 + basis (inner - value 1) basis'.

    Attributes
    ----------
    basis : ndarray, shape (p, N)
        Orthonormal.
    inner : ndarray, shape (N, N)
    into, drives : ndarray, shapes (N, K) and (K, N)
        Of the modes of a structure.
    value : float or None
        Of the p - N other directions; None if there are none.
    """

    basis: Array
    inner: Array
    into: Array
    drives: Array
    value: float | None

    def gains(self) -> tuple[Complex, Complex]:
        """Return the eigenvalues of B and their vectors (p, g), those of what is alike once."""
        values, vectors = np.linalg.eig(self.inner)
        found = values.astype(complex), (self.basis @ vectors).astype(complex)
        if self.value is None:
            return found
        rest = np.sqrt(np.maximum(1.0 - np.sum(self.basis**2, axis=1), 0.0))
        return np.append(found[0], self.value), np.column_stack([found[1], rest])

    def core(self) -> "Core":
        """Return the fewest directions in which all its eigenvalues and poles are found.

        B - value 1 = L R of rank r. With U = (L, into) and V = (R, drives), of r + K columns and rows, the
        matrix s_0 value 1 + U D V, D the sizes s_0 (r times) and s_1 ... s_K, has the eigenvalues of
        s_0 value 1 + V U D and, beside these, s_0 value (Sylvester's theorem on determinants).
        """
        n, modes = len(self.inner), self.into.shape[1]
        value = 1.0 if self.value is None else self.value
        left, sizes, right = np.linalg.svd(self.inner - value * np.eye(n))
        rank = int((sizes > _ROUNDED * max(1.0, float(np.abs(self.inner).max(initial=0.0)))).sum())
        if rank + modes > n:
            return Core(self.inner, self.into, self.drives, None, self.value)
        back = np.hstack([left[:, :rank] * sizes[:rank], self.into])
        mixed = np.vstack([right[:rank], self.drives]) @ back
        sees = value * np.eye(rank + modes)
        sees[:, :rank] += mixed[:, :rank]
        left_over = self.value is not None or rank + modes < n
        drives = np.eye(modes, rank + modes, rank)
        return Core(sees, mixed[:, rank:], drives, back, value if left_over else None)

    def whole(self, sizes: Complex) -> Complex:
        """Return the matrix of sizes (1 + K,) of one channel and of what goes through each mode."""
        n = len(self.inner)
        rest = 0 if self.value is None else 1
        found = np.zeros((n + rest, n + rest), dtype=complex)
        found[:n, :n] = sizes[0] * self.inner + (self.into * sizes[1:]) @ self.drives
        if self.value is not None:
            found[n, n] = sizes[0] * self.value
        return found


@dataclass(frozen=True)
class Core:
    """Few directions that have the eigenvalues of `Parts`, not its singular values.

    Attributes
    ----------
    sees, into, drives : ndarray, shapes (q, q), (q, K) and (K, q)
        As inner, into and drives of `Parts`.
    back : ndarray, shape (N, q), or None
        Along the basis of `Parts`, what answers along these directions. Each mode of the structure then is
        driven by a direction of its own, the last K. None: they are those of the basis.
    value : float or None
        Of all other directions.
    """

    sees: Array
    into: Array
    drives: Array
    back: Array | None
    value: float | None

    def plant(self, channels: tuple[LinearModel, ...], acts: int) -> tuple[LinearModel, Array]:
        """Return the plant of one channel and of what goes through each mode, and what its first states move.

        That is (N, states), along the basis of `Parts`. The first `acts` states of a channel are those of the
        actuator, the last are commands that wait. Where a mode is driven by a direction of its own, they are
        the same in both and stand there once.
        """
        rigid, *through = channels
        if self.back is None:
            plant = coupled(channels, self.sees, self.into, self.drives)
            return plant, np.asarray(np.kron(rigid.c, np.eye(len(self.sees))), dtype=np.float64)
        alone = len(self.sees) - len(through)
        models = (*[rigid] * alone, *through)
        seen = []
        for place, one in enumerate(models):
            own = np.zeros((1, len(one.a)))
            own[:, :acts], own[:, acts - len(rigid.a) :] = rigid.c[:, :acts], rigid.c[:, acts:]
            rows = self.sees[:, [place]] @ own
            seen.append(rows if place < alone else rows + self.into[:, [place - alone]] @ one.c)
        plant = LinearModel(
            block_diag(*(one.a for one in models)),
            block_diag(*(one.b for one in models)),
            np.hstack(seen),
            np.zeros(self.sees.shape),
            rigid.sample_time,
        )
        return plant, self.back @ block_diag(*(one.c for one in models))

    def eigenvalues(self, sizes: Complex) -> Complex:
        """Return the eigenvalues (f, q) of sizes (f, 1 + K), and, last, that of all other directions."""
        found = np.empty((len(sizes), len(self.sees)), dtype=np.complex128)
        for first in range(0, len(sizes), _BLOCK):
            some = sizes[first : first + _BLOCK, None]
            whole = some[..., :1] * self.sees + (self.into * some[..., 1:]) @ self.drives
            found[first : first + _BLOCK] = np.linalg.eigvals(whole)
        return found if self.value is None else np.column_stack([found, sizes[:, 0] * self.value])


def apart(matrix: Array, into: Array, drives: Array) -> Parts:
    """Return a matrix B (p, p), and the modes of a structure (p, K), (K, p), in the directions that matter.

    B is a multiple of 1 but for a matrix of low rank where controllers know their mirror well: then few
    directions are left, found by products with random vectors (Halko, Martinsson and Tropp 2011, algorithm
    4.1), and all others are one loop of one channel.
    """
    p = len(matrix)
    everything = Parts(np.eye(p), matrix, into, drives, None)
    size = float(np.abs(matrix).max(initial=0.0))
    if p < _FEW or not size:
        return everything
    width = p // 6 + 1
    random = np.random.default_rng(0).standard_normal((p, width))
    common, counts = np.unique(np.round(np.diag(matrix), 9), return_counts=True)
    best = everything
    for value in dict.fromkeys([1.0, float(common[counts.argmax()])]):
        right, left = matrix @ random - value * random, matrix.T @ random - value * random
        others = [one / max(float(np.abs(one).max(initial=0.0)), 1e-300) for one in (into, drives.T)]
        columns, sizes, _ = np.linalg.svd(
            np.hstack([right / size, left / size, *others]), full_matrices=False
        )
        kept = int((sizes > _ALIKE * np.sqrt(p)).sum())
        if np.linalg.matrix_rank(right, _ALIKE * size * np.sqrt(p)) == width or kept >= len(best.inner):
            continue
        basis = columns[:, :kept]
        inner = basis.T @ matrix @ basis
        best = Parts(basis, inner, basis.T @ into, drives @ basis, value)
    return best


def coupled(channels: tuple[LinearModel, ...], sees: Array, shown: Array, drives: Array) -> LinearModel:
    """Return y = sees q + shown m of channels q, and of modes m that are driven by drives u, by periods."""
    rigid, *through = channels
    unit = np.eye(sees.shape[1])
    sizes = [len(one.a) for one in through]
    a = np.kron(rigid.a, unit)
    n = len(a)
    whole = np.zeros((n + sum(sizes), n + sum(sizes)))
    whole[:n, :n] = a
    b, c = [np.kron(rigid.b, unit)], [sees @ np.kron(rigid.c, unit)]
    for one, column, row in zip(through, shown.T, drives, strict=True):
        whole[n : n + len(one.a), n : n + len(one.a)] = one.a
        n += len(one.a)
        b.append(one.b @ row[None])
        c.append(column[:, None] @ one.c)
    return LinearModel(whole, np.vstack(b), np.hstack(c), np.zeros(sees.shape), rigid.sample_time)


def stacked(parts: Sequence[LinearModel]) -> LinearModel:
    """Return models of the same inputs as one, their outputs one after the other."""
    return LinearModel(
        block_diag(*(one.a for one in parts)),
        np.vstack([one.b for one in parts]),
        block_diag(*(one.c for one in parts)),
        np.vstack([one.d for one in parts]),
        parts[0].sample_time,
    )


def sizes_of(channels: tuple[LinearModel, ...], hertz: Array) -> Complex:
    """Return the responses (f, 1 + K) of one channel and of what goes through each mode."""
    found = np.empty((len(hertz), len(channels)), dtype=np.complex128)
    period = channels[0].sample_time
    assert period is not None
    z = np.exp(1j * (2 * np.pi * hertz) * period)[:, None, None, None]
    for count in {len(one.a) for one in channels}:
        which = [place for place, one in enumerate(channels) if len(one.a) == count]
        a, b, c, d = (np.stack([getattr(channels[k], name) for k in which]) for name in "abcd")
        for first in range(0, len(hertz), _BLOCK):
            some = slice(first, first + _BLOCK)
            states = np.linalg.solve(z[some] * np.eye(count) - a, b.astype(complex))
            found[some, which] = (c @ states + d)[..., 0, 0]
    return found
