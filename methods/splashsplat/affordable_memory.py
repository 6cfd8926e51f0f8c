"""What of the method a budget of memory leaves room for: the finest grids whose fit stays below it.

What a fit has in memory at most is told from its carriers and grids, which a trace on coarse grids gives cheaply. The
appearance takes most: what is learned of each carrier, with gradients and their moments, and where carriers are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log

from splashbench.harness.contract import Decision, Run, Rung
from splashbench.scene.scene import TrainingScene

from .affordable import with_cells
from .settings import SplashSplatConfig
from .trace import Traced

# Bytes that a fit has at its peak beside the process as it is before the fit: for a carrier, for a byte of the packed
# phi, for a pixel of the largest photograph, and for the rest. All but the pixels are a least-squares fit to twelve
# fits of four scenes on three grids at 240x160, of which it misses none by more than 2.5 %. These had 60 iterations:
# longer ones leave out carriers on the way. Of pixels one fit at 600x400 and one at 1200x1800 tell.
_CARRIER, _DISTANCE, _PIXEL, _REST = 928.0, 0.966, 490.0, 213e6
# Cells along the longest side of the first trace, and the fewest.
_FIRST_CELLS, _FEWEST = 128, 24
# By which power of cells along a side carriers grow, until two traces tell: 2.0 to 2.6 on four scenes.
_GROWTH, _LEAST_GROWTH, _MOST_GROWTH = 2.4, 1.8, 3.0
# Share of the budget that is aimed at, and the least of it that is not worth another trace.
_AIM, _ENOUGH = 0.98, 0.9
_TRACES = 4


@dataclass(frozen=True)
class _Size:
    """What a fit's memory depends on. cells: along the longest side. fixed: bytes that no grid changes."""

    cells: int
    carriers: int
    distance: int
    fixed: float

    @property
    def peak(self) -> float:
        """The most bytes that a fit has in memory at once."""
        return self.fixed + _CARRIER * self.carriers + _DISTANCE * self.distance

    def at(self, cells: int, growth: float) -> _Size:
        """The same scene on another grid, about."""
        scale = cells / self.cells
        return _Size(cells, round(self.carriers * scale**growth), round(self.distance * scale**3), self.fixed)

    def affordable(self, limit: float, most: int, growth: float) -> int:
        """The most cells, of `_FEWEST` to `most`, whose peak stays below `limit` bytes; `_FEWEST` where none does."""
        low, high = _FEWEST, max(most, _FEWEST)
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if self.at(middle, growth).peak <= limit else (low, middle - 1)
        return low


def within_memory(
    scene: TrainingScene,
    config: SplashSplatConfig,
    run: Run,
    loaded: int,
    trace: Callable[[SplashSplatConfig], Traced],
    first: Traced | None = None,
) -> Traced:
    """What `trace` gives for `config` on the finest grids that the run's budget of memory leaves room for.

    loaded: bytes of the process before the fit. first: what `trace` gave for `config` already.
    """
    limit = run.budget.memory_bytes
    if limit is None:
        return first or trace(config)
    aim, fixed, growth = _AIM * limit, _fixed_bytes(scene, loaded), _GROWTH
    most = config.hull_cells
    allowed = most if first else min(_FIRST_CELLS, most)
    traced = first or trace(with_cells(config, allowed))
    size = _size_of(traced, fixed)
    rungs = [_rung(size)]
    # Seconds that are to be kept as well leave room for one trace at full length (affordable.py).
    hurried = run.budget.seconds is not None
    while len(rungs) < _TRACES:
        fits = size.peak <= aim
        if fits and hurried and len(rungs) > 1:
            break
        # Or as fine as the photographs need it, although more cells were allowed.
        finest = allowed == most or size.cells < allowed - 1
        if (fits and (finest or size.peak >= _ENOUGH * aim)) or (not fits and size.cells <= _FEWEST):
            break
        allowed = size.affordable(aim, most if fits else size.cells - 1, growth)
        if fits and allowed <= size.cells + 1:
            break
        traced = trace(with_cells(config, allowed))
        before, size = size, _size_of(traced, fixed)
        growth = _growth(before, size, growth)
        rungs.append(_rung(size))
    rungs[-1] = rungs[-1].model_copy(update={"bought": True})
    run.decide(
        Decision(
            name="grids for the memory",
            basis="budget",
            chosen=rungs[-1].value,
            because=f"{limit / 1e6:.0f} MB are to be kept, of which {fixed / 1e6:.0f} are there on any grid",
            rungs=rungs,
        )
    )
    return traced


def _fixed_bytes(scene: TrainingScene, loaded: int) -> float:
    """Bytes that a fit has in memory whatever its grids are."""
    pixels = max(scene.cameras[name].width * scene.cameras[name].height for name in scene.train)
    return loaded + _REST + _PIXEL * pixels


def _size_of(traced: Traced, fixed: float) -> _Size:
    cells = max(traced.observations.hull_grid.shape) - 1
    return _Size(cells, traced.track.carriers.count, traced.track.phi.nbytes, fixed)


def _growth(one: _Size, other: _Size, otherwise: float) -> float:
    """By which power of cells carriers grow, as two traces tell."""
    if one.cells == other.cells or min(one.carriers, other.carriers) == 0:
        return otherwise
    told = log(other.carriers / one.carriers) / log(other.cells / one.cells)
    return min(max(told, _LEAST_GROWTH), _MOST_GROWTH)


def _rung(size: _Size) -> Rung:
    return Rung(value=f"{size.cells} cells, {size.peak / 1e6:.0f} MB of memory", bought=False)
