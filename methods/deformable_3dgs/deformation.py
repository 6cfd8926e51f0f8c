"""The deformation network: where, how turned and how large a canonical Gaussian is at a time (Yang et al., Eq. 4-5).

(dx, dr, ds) = F(enc(x), enc(t)) with enc(p) = (p, sin(2^k p), cos(2^k p)) for k < L; F has ReLU layers of one width,
gets its input a second time after half of them, and three linear heads.

The octaves suit positions within about +-1.3: positions are first brought there, and what comes out is scaled back, so
that a scene's units do not matter.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

OCTAVES = 10


def encode(values: Tensor, octaves: int = OCTAVES) -> Tensor:
    """[N, D] to [N, D (1 + 2 octaves)]: the values, then sine and cosine of every octave in turn."""
    angles = values[:, None] * 2.0 ** torch.arange(octaves, device=values.device).to(values)[:, None]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=2)
    return torch.cat([values, waves.flatten(1)], dim=1)


class Deformation(nn.Module):
    """F: positions [N, 3] and a time in [0, 1] to shifts [N, 3], turns [N, 4] and growths [N, 3]; scene units.

    center [3], unit: of the box that the octaves suit, scene units. With time_features, a small network first turns the
    time's octaves into so many features, as published for synthetic scenes.
    """

    center: Tensor
    unit: Tensor

    def __init__(self, depth: int = 8, width: int = 256, time_octaves: int = OCTAVES, time_features: int = 0) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("unit", torch.ones(()))
        self._time_octaves, times = time_octaves, 1 + 2 * time_octaves
        self.times: nn.Module = nn.Identity()
        if time_features:
            self.times = nn.Sequential(nn.Linear(times, 256), nn.ReLU(), nn.Linear(256, time_features))
            times = time_features
        self._inputs = 3 * (1 + 2 * OCTAVES) + times
        self._again = depth // 2
        sizes = [self._inputs] + [width] * (depth - 1)
        self.layers = nn.ModuleList(
            nn.Linear(size + (self._inputs if i == self._again + 1 else 0), width) for i, size in enumerate(sizes)
        )
        self.shift, self.turn, self.growth = nn.Linear(width, 3), nn.Linear(width, 4), nn.Linear(width, 3)

    def silence(self) -> None:
        """Zero the heads: nothing moves until the fit says so. As published, the start is a random deformation."""
        with torch.no_grad():
            for head in (self.shift, self.turn, self.growth):
                head.weight.zero_()
                head.bias.zero_()

    def forward(self, positions: Tensor, time: float) -> tuple[Tensor, Tensor, Tensor]:
        encoded = encode((positions - self.center) / self.unit)
        # The time is the same for all: its encoding, and what layers make of it, are worked out once.
        times = self.times(encode(positions.new_full((1, 1), time), self._time_octaves))[0]
        hidden = torch.relu_(self._of_inputs(self.layers[0], encoded, times))
        for i, layer in enumerate(self.layers[1:], start=1):
            if i == self._again + 1:
                hidden = torch.addmm(self._of_inputs(layer, encoded, times), hidden, layer.weight[:, self._inputs :].T)
            else:
                hidden = layer(hidden)
            hidden = torch.relu_(hidden)
        heads = (self.shift, self.turn, self.growth)
        out = nn.functional.linear(
            hidden, torch.cat([head.weight for head in heads]), torch.cat([head.bias for head in heads])
        )
        shift, turn, growth = out.split([head.out_features for head in heads], dim=1)
        return self.unit * shift, turn, self.unit * growth

    def _of_inputs(self, layer: nn.Linear, encoded: Tensor, times: Tensor) -> Tensor:
        """What `layer` makes of its first inputs, positions `encoded` [N, P] and then `times` [T], with its bias."""
        places = encoded.shape[1]
        bias = layer.bias + layer.weight[:, places : self._inputs] @ times
        return nn.functional.linear(encoded, layer.weight[:, :places], bias)
