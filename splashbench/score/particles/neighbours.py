"""Sums over the nearest neighbours of every particle, by a list of cells: exact, and faster than a k-d tree.

Points are sorted into cubic cells small enough that the cells around a point hold little more than the neighbours it
needs. Where they hold fewer, the block of cells grows. Points for which it does not grow far enough, or holds far more
than it should, get cells of another size, that of the median among them. So clumps, sheets and strays cost a little
time and no accuracy.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.parallel import over_range
from splashbench.score.particles.copies import limited_copies

#: Points in a cell, on the median, for each neighbour: enough then lie within a cell's edge of most points, in a volume
#: as in a sheet. With fewer, blocks have to grow; with more, they hold too much.
_PER_NEIGHBOUR = 0.5
_SHRINKINGS = 12
#: Cells along an axis at most, around the middle of the points, so that a cell's number fits 64 bits; points beyond
#: count as in the outermost.
_MAX_CELLS = 1 << 20
#: Of a cell's edge: more than rounding can be off by in telling which of so many cells a point is in.
_MARGIN = 1e-9
#: The block's half width at most, in cells, before cells of another size are made, at last one for all points.
_WIDEST = 3
_MIN_POINTS_PER_THREAD = 512
#: Blocks of 27 cells with more points for each neighbour are crowded: five times what they hold on the median.
_CROWDED = 64
#: How many sizes of cells are tried before all points are looked at for each that is left; and for how few of them
#: that is done at once, since other cells would take longer.
_MAX_LEVELS, _FEW = 16, 1000
#: In place of a sum, none of which is below 0.
_TOO_LARGE, _TOO_SMALL = -1.0, -2.0
#: Of the radius: points this near to each other are at one place, whose sum is off by less than 1e-11 of itself.
_ONE_PLACE = 1e-6


def nearest_poly6_sums(points: NDArray[np.float64], neighbours: int, radius: float) -> NDArray[np.float64]:
    """Sum of (radius^2 - r^2)^3 over the `neighbours` nearest of each of `points` [N, 3], itself excluded: [N].

    r is the distance; neighbours at `radius` and beyond add nothing. Where a point has fewer than `neighbours` others,
    all count. Points must be finite.
    """
    if len(points) == 0:
        return np.zeros(0)
    copies = limited_copies(points, neighbours + 1)
    if copies is not None:
        kept, place = copies
        return nearest_poly6_sums(points[kept], neighbours, radius)[place]
    sums = np.empty(len(points))
    groups = [(np.arange(len(points)), False)]
    level = 0
    while groups:
        level += 1
        pending, is_last = groups.pop()
        left = _level(points, pending, neighbours, radius, sums, is_last or level >= _MAX_LEVELS)
        groups += [(group, len(group) < _FEW or len(group) == len(pending)) for group in left if len(group)]
    return sums


def _level(
    points: NDArray[np.float64],
    pending: NDArray[np.intp],
    neighbours: int,
    radius: float,
    sums: NDArray[np.float64],
    is_last: bool,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Fill in sums[pending] with cells of the size that suits the median of these points.

    Returns those for which such cells are too large, and those for which they are too small. On the last level there
    are none.
    """
    # Of the median: strays far off must not move all others to the edge of the cells there are.
    offsets = points - np.median(points[pending], axis=0)
    size = _cell_size(offsets, _PER_NEIGHBOUR * neighbours, radius, pending)
    cells = _cells(offsets, size)
    shape = cells.max(axis=0) + 1
    keys = _keys(cells, shape)
    order = np.argsort(keys, kind="stable")
    place = np.empty(len(points), dtype=np.intp)
    place[order] = np.arange(len(points))
    numbers = np.sort(place[pending])
    # In the outermost cells there are points that are anywhere.
    is_small = np.zeros(len(points), dtype=bool)
    if size < _ONE_PLACE * radius:
        is_small |= (np.abs(offsets[order]) < (_MAX_CELLS // 2 - 2) * size).all(axis=1)
    found = np.empty(len(points))
    over_range(
        _sum_nearest,
        len(numbers),
        numbers,
        np.ascontiguousarray(points[order]),
        cells[order],
        keys[order],
        shape,
        size,
        neighbours,
        radius,
        is_small,
        is_last,
        found,
        smallest=_MIN_POINTS_PER_THREAD,
    )
    sums[pending] = found[place[pending]]
    return pending[sums[pending] == _TOO_LARGE], pending[sums[pending] == _TOO_SMALL]


def _cells(offsets: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """Cell [N, 3] of each of `offsets` [N, 3] from the middle, counted from 0."""
    half = _MAX_CELLS // 2
    cells = np.clip(np.floor(offsets / size), -half, half - 1).astype(np.int64)
    return cells - cells.min(axis=0)


def _keys(cells: NDArray[np.int64], shape: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of each cell; cells that differ in z alone follow one another."""
    return (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]


def _cell_size(
    offsets: NDArray[np.float64], target: float, radius: float, among: NDArray[np.intp] | slice = slice(None)
) -> float:
    """Edge of cells that hold about `target` points where the median one `among` them is; hardly above `radius`."""
    size = (1 + 2 * _MARGIN) * radius
    for _ in range(_SHRINKINGS):
        cells = _cells(offsets, size)
        _, inverse, counts = np.unique(_keys(cells, cells.max(axis=0) + 1), return_inverse=True, return_counts=True)
        median_count = float(np.median(counts[inverse][among]))
        if median_count <= 1.3 * target:
            break
        # Between a sheet's square and a volume's cube.
        size *= max(0.25, (target / median_count) ** 0.4)
    return size


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _first(keys: np.ndarray, key: int) -> int:
    """How many of the ascending `keys` are below `key`."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _collect(
    points: np.ndarray, number: int, first: int, last: int, limit: float, squares: np.ndarray, count: int
) -> int:
    """Append to `squares` the squared distances below `limit` of point `number` to points[first:last]; the new count.

    count: elements that `squares` holds already. It needs room for one element more than are appended.
    """
    x, y, z = points[number, 0], points[number, 1], points[number, 2]
    for other in range(first, last):
        dx, dy, dz = points[other, 0] - x, points[other, 1] - y, points[other, 2] - z
        square = dx * dx + dy * dy + dz * dz
        # Written whether or not it counts: a branch would be guessed wrong every other time.
        squares[count] = square
        count += (square < limit) & (other != number)
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smallest_first(values: np.ndarray, count: int, n_smallest: int) -> None:
    """Reorder values[:count] so that the `n_smallest` smallest come first (Hoare's selection)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if n_smallest - 1 <= j:
            high = j
        elif n_smallest - 1 >= i:
            low = i
        else:
            return


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_nearest(
    numbers: np.ndarray,
    points: np.ndarray,
    cells: np.ndarray,
    keys: np.ndarray,
    shape: np.ndarray,
    size: float,
    neighbours: int,
    radius: float,
    is_small: np.ndarray,
    is_last: bool,
    sums: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """sums of the points numbers[start:stop]; `points` are sorted by the `keys` of their `cells`.

    Unless `is_last`, a point with a crowded block has _TOO_LARGE, and one with too few neighbours in the widest block
    _TOO_SMALL. Where a point `is_small`, all of its block is at its place.
    """
    squares = np.empty(len(points) + 1)
    rows = (2 * _WIDEST + 1) ** 2
    firsts, lasts = np.empty(rows, np.int64), np.empty(rows, np.int64)
    of_cell, of_half, n_rows = -1, 0, 0  # whose rows of cells these are
    for number in numbers[start:stop]:
        count = 0
        total = 0.0
        half = 1
        while True:
            if half > _WIDEST and not is_last:
                count, total = 0, _TOO_SMALL
                break
            if half > _WIDEST:
                count = _collect(points, number, 0, len(points), radius * radius, squares, 0)
                break
            if of_cell != keys[number] or of_half != half:
                of_cell, of_half, n_rows = keys[number], half, 0
                z_low, z_high = max(cells[number, 2] - half, 0), min(cells[number, 2] + half, shape[2] - 1)
                for i in range(max(cells[number, 0] - half, 0), min(cells[number, 0] + half, shape[0] - 1) + 1):
                    for j in range(max(cells[number, 1] - half, 0), min(cells[number, 1] + half, shape[1] - 1) + 1):
                        row = (i * shape[1] + j) * shape[2]
                        firsts[n_rows] = _first(keys, row + z_low)
                        lasts[n_rows] = _first(keys, row + z_high + 1)
                        n_rows += 1
            if half == 1:
                looked_at = 0
                for n in range(n_rows):
                    looked_at += lasts[n] - firsts[n]
                if is_small[number] and looked_at > neighbours:
                    count, total = 0, neighbours * radius**6
                    break
                if looked_at > _CROWDED * neighbours and not is_last:
                    count, total = 0, _TOO_LARGE
                    break
            # Whatever is nearer than this is in the block.
            reach = min((1 - _MARGIN) * half * size, radius)
            count = looked_at = 0
            for n in range(n_rows):
                looked_at += lasts[n] - firsts[n]
                count = _collect(points, number, firsts[n], lasts[n], reach * reach, squares, count)
            if count >= neighbours or reach >= radius:
                break
            # A wider block is of use only while there is something around this one.
            half = half + 1 if looked_at < len(points) else _WIDEST + 1
        if count > neighbours:
            _smallest_first(squares, count, neighbours)
            count = neighbours
        for k in range(count):
            inner = radius * radius - squares[k]
            total += inner * inner * inner
        sums[number] = total
