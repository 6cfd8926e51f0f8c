"""Front-to-back alpha compositing of one tile's splats, and its gradients from back to front.

A pixel's colour is sum_i c_i alpha_i T_i + T_end background, with T_i = prod_{j<i} (1 - alpha_j) (3D Gaussian
splatting, eq. 3). Each splat visits only the columns its ellipse covers in each row. The inner loops have no branches
and a length in whole vectors, so that the compiler turns them into vector instructions; a pixel that takes no part
gets a weight of zero. Gradients are written to one slot per (splat, tile) and summed elsewhere: no atomics, and the
same bits on every run.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from splashbench.render.constants import (
    LOG2_MAX_ALPHA,
    LOG2_MIN_ALPHA,
    MIN_TRANSMITTANCE,
    TILE_HEIGHT,
    TILE_WIDTH,
)
from splashbench.render.projection import (
    BLUE,
    GREEN,
    HALF_HEIGHT,
    LOG2_OPACITY,
    RED,
    ROW_FALL,
    ROW_SCALE,
    SLOPE,
    A,
    B,
    C,
    Scalar,
    X,
    Y,
)

PIXELS = TILE_WIDTH * TILE_HEIGHT
# Parts of a tile's scratch buffer, one after another; constant distances let the compiler see they never overlap.
_T, _R, _G, _B, _LAST, _REST = 0, PIXELS, 2 * PIXELS, 3 * PIXELS, 4 * PIXELS, 5 * PIXELS
_LANES = 8
_CHECK_EVERY = 32

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LOG2_MIN_ALPHA = np.float32(LOG2_MIN_ALPHA)
_LOG2_MAX_ALPHA = np.float32(LOG2_MAX_ALPHA)
_MIN_TRANSMITTANCE = np.float32(MIN_TRANSMITTANCE)
_SLACK = np.float32(2e-3)
# 2^x on [-1, 0] as a polynomial (Chebyshev fit, relative error 2e-8), lowest power first.
_EXP2 = tuple(
    np.float32(c)
    for c in np.polynomial.Chebyshev.interpolate(lambda x: 2.0**x, 6, domain=[-1, 0])
    .convert(kind=np.polynomial.Polynomial)
    .coef
)
_EIGHTH = np.float32(0.125)


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _exp2(x: Scalar) -> Scalar:
    """2^x for x in [-8, 0]: a polynomial for 2^(x/8), squared three times. Vectorises, unlike math.exp2."""
    x = x * _EIGHTH
    p = _EXP2[6]
    p = p * x + _EXP2[5]
    p = p * x + _EXP2[4]
    p = p * x + _EXP2[3]
    p = p * x + _EXP2[2]
    p = p * x + _EXP2[1]
    p = p * x + _EXP2[0]
    p = p * p
    p = p * p
    return p * p


@numba.njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _row_span(s: np.ndarray, dy: Scalar, x0: Scalar, columns: int) -> tuple[int, int]:
    """First column and number of columns that splat `s` covers in the row at offset dy, in whole vectors."""
    squared = s[ROW_SCALE] - s[ROW_FALL] * dy * dy
    half = math.sqrt(max(squared, _ZERO)) + _SLACK
    middle = s[X] - x0 - _HALF + s[SLOPE] * dy
    first = max(0, math.ceil(middle - half))
    last = min(columns - 1, math.floor(middle + half))
    if last < first:
        return 0, 0
    first -= first % _LANES
    return first, (last - first) // _LANES * _LANES + _LANES


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def composite(
    splats: np.ndarray,
    tile_starts: np.ndarray,
    entries: np.ndarray,
    mask: np.ndarray,
    order: np.ndarray,
    worker: int,
    workers: int,
    background: np.ndarray,
    rgb: np.ndarray,
    transmittance: np.ndarray,
    last: np.ndarray,
) -> None:
    """Composite the tiles order[worker::workers].

    Args:
        splats, tile_starts, entries, mask: see tiles.sort_into_tiles.
        background: float32 [H, W, 3], or [1, 1, 3] for one colour everywhere.
        rgb [H, W, 3], transmittance [H, W], last [H, W] (index into the tile's list of the last splat that
            contributed, -1 for none): float32, filled in.
    """
    height, width = transmittance.shape
    columns_of_tiles = mask.shape[1]
    step_y, step_x = int(background.shape[0] > 1), int(background.shape[1] > 1)
    scratch = np.empty(_REST, np.float32)
    offsets = np.empty(TILE_WIDTH, np.float32)
    for column in range(TILE_WIDTH):
        offsets[column] = np.float32(column) + _HALF
    dead = np.empty(TILE_HEIGHT, np.bool_)
    for at in range(worker, len(order), workers):
        tile = order[at]
        y0 = (tile // columns_of_tiles) * TILE_HEIGHT
        x0 = (tile % columns_of_tiles) * TILE_WIDTH
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        for p in range(PIXELS):
            scratch[_T + p] = _ONE
            scratch[_R + p] = _ZERO
            scratch[_G + p] = _ZERO
            scratch[_B + p] = _ZERO
            scratch[_LAST + p] = -_ONE
        # A pixel beyond the image's right edge is finished from the start (T <= 0 marks finished).
        for row in range(TILE_HEIGHT):
            dead[row] = row >= rows
            for column in range(columns, TILE_WIDTH):
                scratch[_T + row * TILE_WIDTH + column] = -_ONE
        start, stop = tile_starts[tile], tile_starts[tile + 1]
        for entry in range(start, stop):
            s = splats[entries[entry, 0]]
            top = max(0, math.ceil(s[Y] - s[HALF_HEIGHT] - _HALF - _SLACK) - y0)
            bottom = min(rows - 1, math.floor(s[Y] + s[HALF_HEIGHT] - _HALF + _SLACK) - y0)
            index = np.float32(entry - start)
            red, green, blue = s[RED], s[GREEN], s[BLUE]
            a = s[A]
            for row in range(top, bottom + 1):
                if dead[row]:
                    continue
                dy = np.float32(y0 + row) + _HALF - s[Y]
                first, count = _row_span(s, dy, np.float32(x0), columns)
                b, c = s[B] * dy, s[C] * dy * dy + s[LOG2_OPACITY]
                gx = s[X] - np.float32(x0 + first)
                line = scratch[row * TILE_WIDTH + first :]
                for x in range(count):
                    dx = offsets[x] - gx
                    q = (a * dx + b) * dx + c
                    t, latest = line[_T + x], line[_LAST + x]
                    alpha = _exp2(max(min(q, _LOG2_MAX_ALPHA), _LOG2_MIN_ALPHA))
                    after = t - t * alpha
                    visible = (q >= _LOG2_MIN_ALPHA) & (t > _ZERO)
                    drawn = visible & (after > _MIN_TRANSMITTANCE)
                    weight = alpha * t if drawn else _ZERO
                    line[_T + x] = after if drawn else (-t if visible else t)
                    line[_R + x] += weight * red
                    line[_G + x] += weight * green
                    line[_B + x] += weight * blue
                    line[_LAST + x] = index if drawn else latest
            if (entry - start) % _CHECK_EVERY == _CHECK_EVERY - 1:
                alive = 0
                for row in range(rows):
                    if not dead[row]:
                        top_t = -_ONE
                        for p in range(row * TILE_WIDTH, (row + 1) * TILE_WIDTH):
                            top_t = max(top_t, scratch[_T + p])
                        dead[row] = top_t <= _ZERO
                        alive += not dead[row]
                if alive == 0:
                    break
        for row in range(rows):
            y = y0 + row
            for column in range(columns):
                p, x = row * TILE_WIDTH + column, x0 + column
                t = abs(scratch[_T + p])
                behind = background[y * step_y, x * step_x]
                rgb[y, x, 0] = scratch[_R + p] + t * behind[0]
                rgb[y, x, 1] = scratch[_G + p] + t * behind[1]
                rgb[y, x, 2] = scratch[_B + p] + t * behind[2]
                transmittance[y, x] = t
                last[y, x] = scratch[_LAST + p]


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"}, inline="always")
def _exponent(a: Scalar, b: Scalar, c: Scalar, dx: Scalar) -> Scalar:
    """log2 alpha of a splat; apart, so that `composite_backward` may reorder sums but not this."""
    return (a * dx + b) * dx + c


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def composite_backward(
    splats: np.ndarray,
    tile_starts: np.ndarray,
    entries: np.ndarray,
    mask: np.ndarray,
    order: np.ndarray,
    worker: int,
    workers: int,
    background: np.ndarray,
    transmittance: np.ndarray,
    last: np.ndarray,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
    slots: np.ndarray,
) -> None:
    """Fill the slots [S, 9] of the tiles order[worker::workers]; see projection.project_backward for their meaning.

    grad_rgb [H, W, 3] and grad_alpha [H, W] are the gradients of the loss, float32; the rest as `composite` left it.
    """
    height, width = transmittance.shape
    columns_of_tiles = mask.shape[1]
    step_y, step_x = int(background.shape[0] > 1), int(background.shape[1] > 1)
    scratch = np.empty(6 * PIXELS, np.float32)
    offsets = np.empty(TILE_WIDTH, np.float32)
    for column in range(TILE_WIDTH):
        offsets[column] = np.float32(column) + _HALF
    for at in range(worker, len(order), workers):
        tile = order[at]
        start, stop = tile_starts[tile], tile_starts[tile + 1]
        y0 = (tile // columns_of_tiles) * TILE_HEIGHT
        x0 = (tile % columns_of_tiles) * TILE_WIDTH
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        deepest = -_ONE
        scratch[:] = _ZERO
        for row in range(TILE_HEIGHT):
            for column in range(TILE_WIDTH):
                p, y, x = row * TILE_WIDTH + column, y0 + row, x0 + column
                scratch[_LAST + p] = -_ONE
                if row < rows and column < columns:
                    t = transmittance[y, x]
                    behind = background[y * step_y, x * step_x]
                    g0, g1, g2 = grad_rgb[y, x, 0], grad_rgb[y, x, 1], grad_rgb[y, x, 2]
                    scratch[_T + p] = t
                    scratch[_R + p], scratch[_G + p], scratch[_B + p] = g0, g1, g2
                    scratch[_LAST + p] = last[y, x]
                    deepest = max(deepest, last[y, x])
                    # What lies behind the splat at hand contributes _REST to the loss (first order), here T_end alone.
                    scratch[_REST + p] = t * (g0 * behind[0] + g1 * behind[1] + g2 * behind[2] - grad_alpha[y, x])
        first_unused = start + int(deepest) + 1
        for entry in range(first_unused, stop):
            for j in range(9):
                slots[entries[entry, 1], j] = _ZERO
        for entry in range(first_unused - 1, start - 1, -1):
            s = splats[entries[entry, 0]]
            top = max(0, math.ceil(s[Y] - s[HALF_HEIGHT] - _HALF - _SLACK) - y0)
            bottom = min(rows - 1, math.floor(s[Y] + s[HALF_HEIGHT] - _HALF + _SLACK) - y0)
            index = np.float32(entry - start)
            red, green, blue = s[RED], s[GREEN], s[BLUE]
            a = s[A]
            m, mx, my, mxx, mxy, myy, c0, c1, c2 = (
                _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO,
            )  # fmt: skip
            for row in range(top, bottom + 1):
                dy = np.float32(y0 + row) + _HALF - s[Y]
                first, count = _row_span(s, dy, np.float32(x0), columns)
                b, c = s[B] * dy, s[C] * dy * dy + s[LOG2_OPACITY]
                gx = s[X] - np.float32(x0 + first)
                line = scratch[row * TILE_WIDTH + first :]
                row_m, row_mx, row_mxx = _ZERO, _ZERO, _ZERO
                for x in range(count):
                    dx = offsets[x] - gx
                    q = _exponent(a, b, c, dx)
                    drawn = (q >= _LOG2_MIN_ALPHA) & (index <= line[_LAST + x])
                    alpha = _exp2(max(min(q, _LOG2_MAX_ALPHA), _LOG2_MIN_ALPHA))
                    alpha = alpha if drawn else _ZERO
                    kept = _ONE / (_ONE - alpha)
                    t = line[_T + x] * kept
                    rest = line[_REST + x]
                    g0, g1, g2 = line[_R + x], line[_G + x], line[_B + x]
                    weight = alpha * t
                    here = g0 * red + g1 * green + g2 * blue
                    c0 += weight * g0
                    c1 += weight * g1
                    c2 += weight * g2
                    line[_T + x] = t
                    line[_REST + x] = rest + weight * here
                    # dL/dalpha = T (g . c) - (what lies behind) / (1 - alpha); none where alpha was clamped.
                    grad = alpha * (t * here - kept * rest)
                    grad = grad if q <= _LOG2_MAX_ALPHA else _ZERO
                    row_m += grad
                    row_mx += grad * dx
                    row_mxx += grad * dx * dx
                m += row_m
                mx += row_mx
                mxx += row_mxx
                my += row_m * dy
                mxy += row_mx * dy
                myy += row_m * dy * dy
            slot = slots[entries[entry, 1]]
            slot[0], slot[1], slot[2], slot[3], slot[4], slot[5] = m, mx, my, mxx, mxy, myy
            slot[6], slot[7], slot[8] = c0, c1, c2
