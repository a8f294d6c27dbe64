"""Nested dissection of sparse symmetric matrices: the order of elimination, and what it will cost.

The graph of a matrix is halved again and again; what is between two halves is eliminated after both (George
1973). Halves come from distances in the graph, as coordinates are not needed for that. The tree of fronts
says exactly how many numbers the factors hold and how many operations they take before one is computed.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray
from scipy.sparse import csc_array

Array = NDArray[np.float64]
Places = NDArray[np.int64]

LEAF = 120
"""Parts up to this size are eliminated as one dense block."""
LANDMARKS = 9
"""Variables, far from each other, from which distances are counted."""
AXES = 3
"""Principal directions of these distances across which halves are tried."""
LEVELS = (0.4, 0.45, 0.5, 0.55, 0.6)
BALANCE = 0.25
"""Least share of each half."""


@dataclass(frozen=True)
class Front:
    """Variables that are eliminated together, by their places in the order of elimination.

    Attributes
    ----------
    first, last : int
        The variables first..last - 1.
    border : ndarray of int
        Variables after them that they are coupled with once all before are eliminated, ascending.
    children : tuple of int
        Fronts whose border begins here.
    """

    first: int
    last: int
    border: Places
    children: tuple[int, ...]


@dataclass(frozen=True)
class Dissection:
    """An order of elimination, and its fronts, each after its children.

    Attributes
    ----------
    order : ndarray of int, shape (n,)
        Which variable is eliminated at which place.
    fronts : tuple of Front
    """

    order: Places
    fronts: tuple[Front, ...]

    @property
    def entries(self) -> int:
        """Numbers that the factors of a symmetric matrix hold."""
        return sum(own * (own + len(front.border)) for front, own in self._sizes())

    def operations(self, definite: bool) -> float:
        """Return how many multiplications and additions the factorization takes."""
        total = 0.0
        for front, own in self._sizes():
            border = float(len(front.border))
            total += own**3 / 3 + own**2 * border + own * border**2
        return total if definite else 2 * total

    @property
    def peak(self) -> int:
        """Most numbers that are held at one time: factors, a front and its parts, and what is passed on."""
        held = most = 0
        for front, own in self._sizes():
            border = len(front.border)
            most = max(most, held + (own + border) ** 2 + own * (own + border) + border**2)
            held += own * (own + border) + border**2
            held -= sum(len(self.fronts[child].border) ** 2 for child in front.children)
        return most

    def memory(self, itemsize: int) -> int:
        """Return the bytes that a factorization holds at most, for numbers of `itemsize` bytes."""
        return self.peak * itemsize + 8 * sum(len(front.border) for front in self.fronts)

    def _sizes(self) -> list[tuple[Front, int]]:
        return [(front, front.last - front.first) for front in self.fronts]


def dissect(matrix: csc_array) -> Dissection:
    """Return the order of elimination of a matrix with symmetric pattern, shape (n, n)."""
    group, graph = _compressed(matrix)
    size = graph.shape[0]
    leaf = max(1, LEAF * size // matrix.shape[0])
    columns = np.repeat(np.arange(size), np.diff(graph.indptr))
    below = graph.indices > columns  # each coupling once
    edges = np.stack([graph.indices[below].astype(np.int64), columns[below]])
    count, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    splitter = _Splitter(_axes(graph, part, count), np.full(size, -1, dtype=np.int8))
    by_part, edge_part = np.argsort(part, kind="stable"), part[edges[0]]
    bounds = np.searchsorted(part[by_part], np.arange(count + 1))
    by_edge = np.argsort(edge_part, kind="stable")
    edge_bounds = np.searchsorted(edge_part[by_edge], np.arange(count + 1))
    parts: list[tuple[Places, int]] = []  # variables and parent of each front, parents before children
    for index in range(count):
        own = edges[:, by_edge[edge_bounds[index] : edge_bounds[index + 1]]]
        stack = [(by_part[bounds[index] : bounds[index + 1]], own, -1)]
        while stack:
            variables, inner, parent = stack.pop()
            found = splitter.halve(variables, inner) if len(variables) > leaf else None
            if found is None:
                parts.append((variables, parent))
                continue
            separator, halves = found
            parts.append((separator, parent))
            stack += [(*half, len(parts) - 1) for half in halves]
    return _fronts(parts, graph, group)


def _compressed(matrix: csc_array) -> tuple[Places, csc_array]:
    """Join variables that are coupled with the same ones (those of a node); return groups and their graph."""
    keys = np.random.default_rng(0).integers(1, 2**63, matrix.shape[0], dtype=np.uint64)
    sums = np.zeros(len(matrix.indices) + 1, dtype=np.uint64)
    np.cumsum(keys[matrix.indices], out=sums[1:])  # modulo 2^64, and so are its differences
    _, first, group = np.unique(
        sums[matrix.indptr[1:]] - sums[matrix.indptr[:-1]], return_index=True, return_inverse=True
    )
    begin, counts = matrix.indptr[first].astype(np.int64), np.diff(matrix.indptr)[first].astype(np.int64)
    rows = group[matrix.indices[_ranges(begin, counts)]]
    columns = np.repeat(np.arange(len(first)), counts)
    graph = csc_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(len(first),) * 2)
    graph.sum_duplicates()
    return group.astype(np.int64), graph


def _ranges(begin: Places, counts: Places) -> Places:
    """Return begin[0], begin[0] + 1, ... counts[0] numbers, then those from begin[1], and so on."""
    result: Places = np.arange(counts.sum()) + np.repeat(begin - np.cumsum(counts) + counts, counts)
    return result


Half = tuple[Places, Places]


class _Splitter:
    """Halve sets of variables; `side` is scratch, -1 everywhere between calls."""

    def __init__(self, axes: Array, side: NDArray[np.int8]) -> None:
        self.axes, self.side = axes, side

    def halve(self, variables: Places, edges: Places) -> tuple[Places, tuple[Half, Half]] | None:
        """Return the separator and both halves, each with its edges; None where there is no cut."""
        side = self.side
        points = self.axes[variables]
        points = points - points.mean(axis=0)
        turn = np.linalg.eigh(points.T @ points)[1][:, ::-1]
        best: tuple[float, Places, NDArray[np.bool_]] | None = None
        for along in (points @ turn).T[:AXES]:
            for level in np.quantile(along, LEVELS):
                right = along > level
                side[variables] = right
                crossing = edges[:, side[edges[0]] != side[edges[1]]].ravel()
                ends = side[crossing]
                touched = [_distinct(crossing[ends == half]) for half in (0, 1)]
                thin = int(len(touched[1]) < len(touched[0]))
                rest = [len(variables) - int(right.sum()), int(right.sum())]
                rest[thin] -= len(touched[thin])
                if min(rest) < BALANCE * len(variables):
                    continue
                cost = len(touched[thin]) * (1.0 + abs(rest[0] - rest[1]) / len(variables))
                if best is None or cost < best[0]:
                    best = (cost, touched[thin], right)
        if best is None:
            side[variables] = -1
            return None
        _, separator, right = best
        side[variables] = right
        side[separator] = 2
        one, other = side[edges[0]], side[edges[1]]
        halves = [
            (variables[side[variables] == half], edges[:, (one == half) & (other == half)]) for half in (0, 1)
        ]
        side[variables] = -1
        return separator, (halves[0], halves[1])


def _distinct(values: Places) -> Places:
    ordered = np.sort(values)
    return ordered[np.diff(ordered, prepend=-1) > 0]


def _axes(matrix: csc_array, part: Places, count: int) -> Array:
    """Return coordinates of the variables, shape (n, LANDMARKS): distances to variables far apart."""
    size = matrix.shape[0]
    distances = np.zeros((size, LANDMARKS))
    first = np.unique(part, return_index=True)[1]
    starts = first
    nearest = np.full(size, np.inf)
    for index in range(-1, LANDMARKS):  # the first search only finds a far end
        found = _distances(matrix, starts)
        if index >= 0:
            distances[:, index] = found
            nearest = np.minimum(nearest, found)
        far = nearest if index >= 0 else found
        order = np.lexsort((far, part))
        starts = order[np.searchsorted(part[order], np.arange(count), side="right") - 1]
    return distances


def _distances(matrix: csc_array, starts: Places) -> Array:
    """Return how many couplings lie between each variable and the nearest of some."""
    found = np.full(matrix.shape[0], np.inf)
    found[starts] = 0.0
    frontier, step = starts, 0
    while len(frontier):
        step += 1
        counts = np.diff(matrix.indptr)[frontier].astype(np.int64)
        near = matrix.indices[_ranges(matrix.indptr[frontier].astype(np.int64), counts)]
        frontier = _distinct(near[np.isinf(found[near])]).astype(np.int64)
        found[frontier] = step
    return found


def _fronts(parts: list[tuple[Places, int]], graph: csc_array, group: Places) -> Dissection:
    """Return the fronts of the parts (of groups of variables) of a tree, children first."""
    sequence = list(range(len(parts)))[::-1]  # parents stand before their children
    number = {old: new for new, old in enumerate(sequence)}
    order = np.concatenate([parts[old][0] for old in sequence])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    sizes = np.bincount(group, minlength=len(order))[order]
    begins = np.concatenate([[0], np.cumsum(sizes)])
    children: list[list[int]] = [[] for _ in parts]
    borders: list[Places] = []
    fronts: list[Front] = []
    first = 0
    for old in sequence:
        members, parent = parts[old]
        last, mine = first + len(members), len(fronts)
        counts = np.diff(graph.indptr)[members].astype(np.int64)
        coupled = place[graph.indices[_ranges(graph.indptr[members].astype(np.int64), counts)]]
        border = _distinct(np.concatenate([coupled, *(borders[child] for child in children[mine])]))
        borders.append(border[border >= last])
        spread = _ranges(begins[borders[-1]], sizes[borders[-1]])
        fronts.append(Front(int(begins[first]), int(begins[last]), spread, tuple(children[mine])))
        if parent >= 0:
            children[number[parent]].append(mine)
        first = last
    return Dissection(np.argsort(place[group], kind="stable"), tuple(fronts))
