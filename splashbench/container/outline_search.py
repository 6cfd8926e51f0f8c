"""The body whose outline lies on the strongest edges of the clean plates, about one that is known roughly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splashbench.arrays import Floats
from splashbench.container.body_search import CIRCULAR, HEIGHT, bend, best_about, grown, rings
from splashbench.container.outline_views import EdgeView
from splashbench.container.standing import ContainerView, Place

#: Blurs of edges in pixels, each with the steps of a search in it, as shares of the size.
BLURS = ((4.0, 0.05), (2.0, 0.02), (1.2, 0.01))
# Evaluations of a search, and of one after a push.
_EVALUATIONS, _PUSH_EVALUATIONS = 200, 80
# Outlines that the edges are compared with, as shares of the size.
_BESIDE = (0.9, 0.95, 1.05, 1.1)


class OutlineSearch:
    """Looks for the body on `place` in `views`.

    size: of the numbers that may change, the first ones (body_search.py). bends, held: what a bend of the profile
    costs, and what pixels are worth that speak for the container and are held. shown: bool [H, W] a view, what windows
    are about; where views show the container if None.
    """

    def __init__(
        self,
        place: Place,
        views: Sequence[ContainerView],
        size: Floats,
        bends: float,
        held: float,
        shown: Sequence[NDArray[np.bool_]] | None = None,
    ) -> None:
        self._place, self._views, self._size = place, views, size
        self._bends, self._held = bends, held
        self._shown = [view.says > 0 for view in views] if shown is None else shown
        self._edges: list[EdgeView] = []
        self._speaking = 0.0

    def blur(self, pixels: float) -> None:
        """Blur edges by so much from now on; before all else."""
        self._edges = [EdgeView.blurred(view, shown, pixels) for view, shown in zip(self._views, self._shown)]
        self._speaking = sum(view.speaking for view in self._edges)

    def strength_and_held(self, numbers: Floats) -> tuple[float, float]:
        """How strong edges are along the outline, 0 to 1, and `BodySearch.held`, of the body of `numbers`."""
        drawn = rings(self._place, numbers)
        strengths, held = zip(*(view.strength_and_held(drawn) for view in self._edges))
        return float(np.mean(strengths)), sum(held) / self._speaking

    def cost(self, numbers: Floats) -> float:
        """What is least where the outline lies on edges."""
        strength, held = self.strength_and_held(numbers)
        return self._bends * bend(numbers) - strength - self._held * held

    def settled(self, numbers: Floats, step: float) -> Floats:
        """The numbers about `numbers` of least cost. step: of the search, as a share of the size."""
        return best_about(self.cost, numbers, step * self._size, _EVALUATIONS)

    def pushed(self, numbers: Floats, which: int | slice, push: float) -> Floats:
        """The same after some numbers were pushed by `push` of their size, where that costs less: an outline may hang
        on edges beside its own."""
        start = numbers.copy()
        start[which] += push * self._size[which]
        if (start[HEIGHT:CIRCULAR] <= 0).any():
            return numbers
        return min(numbers, best_about(self.cost, start, -0.5 * push * self._size, _PUSH_EVALUATIONS), key=self.cost)

    def contrast(self, numbers: Floats) -> float:
        """How strong edges are along the outline, by those along outlines a little smaller and larger."""
        along, *beside = (self.strength_and_held(grown(numbers, share))[0] for share in (1.0, *_BESIDE))
        return along / max(float(np.mean(beside)), 1e-6)
