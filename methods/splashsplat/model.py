"""The liquid as fitted: carriers, motion, signed distance and appearance, with its files.

Everything is held in the precision in which it is stored, so that a loaded model renders the same image, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, read_npz, write_json
from splashbench.observe.grid import Grid
from splashbench.scene.geometry import MAX_BYTES, SignedDistance
from splashbench.scene.particles import Particles

from .appearance.decoder import Decoder, DecoderSettings
from .appearance.fitting import Appearance, Composition
from .appearance.glass import Glass
from .carriers.between import BetweenFrames
from .carriers.population import Carriers
from .carriers.subframe import Track
from .motion.fall import falls_of, table_of
from .motion.steps import Motion
from .motion.velocity import Factor

# Of models with glass; readers of before would leave it out and not say so.
FORMAT, FORMAT_WITHOUT_GLASS = 4, 3
_GLASS = "glass."
_GLASS_RANKS = {"positions": 2, "log_scales": 2, "quaternions": 2, "opacities": 1, "colors": 2, "slopes": 3}


def _position_steps(grid: Grid) -> float:
    """16-bit steps per transport voxel."""
    return 65535 / max(grid.shape)


def _factor(stored: int | list[float]) -> Factor:
    """Transport voxels per control cell, as liquid.json has them."""
    if not isinstance(stored, list):
        return int(stored)
    fx, fy, fz = (float(width) for width in stored)
    return fx, fy, fz


def store_precision(carriers: Carriers, grid: Grid) -> Carriers:
    """Carriers rounded to what the files hold: 16-bit fixed-point positions, half-precision F and phi."""
    steps = _position_steps(grid)
    positions = np.round(np.clip(carriers.positions * steps, 0, 65535)) / np.float32(steps)
    return replace(
        carriers,
        positions=positions.astype(np.float32),
        deformation=carriers.deformation.astype(np.float16).astype(np.float32),
        phi=carriers.phi.astype(np.float16).astype(np.float32),
    )


@dataclass
class Liquid:
    """The dynamic foreground.

    times: [T] seconds. grid: the transport grid. carriers, motion: in the precision of the files. phi: int8 [T, nx, ny,
    nz], see `pack_signed_distance`. carried: whether the motion is what moved the carriers. composition: how it was
    fitted and is drawn: "over" an image of the background, or "together" with the background's Gaussians.
    between_frames: whose carriers are drawn there, see carriers/between.py.
    """

    times: np.ndarray
    grid: Grid
    carriers: Carriers
    motion: Motion
    phi: np.ndarray
    appearance: Appearance
    carried: bool = True
    composition: Composition = "over"
    between_frames: BetweenFrames = "both"

    @classmethod
    def of(
        cls,
        times: np.ndarray,
        grid: Grid,
        carriers: Carriers,
        motion: Motion,
        phi: np.ndarray,
        appearance: Appearance,
        carried: bool = True,
        composition: Composition = "over",
        between_frames: BetweenFrames = "both",
    ) -> Liquid:
        """Bring the learned tables and the motion to the precision of the files."""
        halves = [table.half().float() for table in (appearance.features, appearance.log_scales)]
        appearance = Appearance(halves[0], halves[1], appearance.decoder, appearance.glass)
        return cls(times, grid, carriers, motion.half(), phi, appearance, carried, composition, between_frames)

    @property
    def track(self) -> Track:
        """The carriers at any time."""
        return Track(self.grid, self.carriers, self.motion, self.phi)

    def particles(self) -> Particles:
        """The carriers as particles, with the velocity of the liquid where they are, scene units per second.

        Without velocities where others than the model's moved them (the variants FLIP and per-frame).
        """
        n_frames, count = self.carriers.n_frames, self.carriers.count
        positions = np.zeros((n_frames, count, 3), dtype=np.float32)
        velocities = np.zeros_like(positions)
        active = np.zeros((n_frames, count), dtype=bool)
        for t in range(n_frames):
            rows = self.carriers.rows(t)
            ids = self.carriers.ids[rows]
            x = self.carriers.positions[rows]
            positions[t, ids] = self.grid.to_scene(x)
            active[t, ids] = True
            if n_frames > 1 and len(ids):
                step = min(t, n_frames - 2)  # the last frame has no step of its own
                seconds = self.times[step + 1] - self.times[step]
                velocities[t, ids] = self.motion.step(step).velocity(x) * (self.grid.voxel / seconds)
        return Particles(positions, active, velocities if self.carried else None)

    def signed_distance(self) -> SignedDistance | None:
        """phi_t of every frame on the transport grid; None where that is more than a submission may hold."""
        return None if self.phi.nbytes > MAX_BYTES else SignedDistance(self.phi, self.grid.origin, self.grid.voxel)

    def save(self, directory: Path) -> None:
        """Write liquid.json and four .npz files into `directory`."""
        settings = self.appearance.decoder.settings
        header = {
            "format": FORMAT_WITHOUT_GLASS if self.appearance.glass is None else FORMAT,
            "times": [float(t) for t in self.times],
            "grid": {
                "origin": [float(x) for x in self.grid.origin],
                "voxel": self.grid.voxel,
                "shape": list(self.grid.shape),
            },
            "factor": self.motion.factor,
            "carriers": self.carriers.count,
            "carried": self.carried,
            "composition": self.composition,
            "between_frames": self.between_frames,
            "decoder": dict(vars(settings)),
        }
        write_json(directory / "liquid.json", header)
        carriers = self.carriers
        positions = np.round(carriers.positions * np.float32(_position_steps(self.grid))).astype(np.uint16)
        np.savez_compressed(
            directory / "carriers.npz",
            starts=carriers.starts,
            ids=carriers.ids,
            positions=positions,
            deformation=carriers.deformation.astype(np.float16),
            phi=carriers.phi.astype(np.float16),
        )
        jets, turn = table_of(self.motion.falls)
        np.savez_compressed(directory / "velocity.npz", velocities=self.motion.velocities, jets=jets, turn=turn)
        np.savez_compressed(directory / "phi.npz", phi=self.phi)
        heads = {f"heads.{name}": value.numpy() for name, value in self.appearance.decoder.state_dict().items()}
        glass = {} if self.appearance.glass is None else self.appearance.glass.tables
        np.savez_compressed(
            directory / "appearance.npz",
            features=self.appearance.features.half().numpy(),
            log_scales=self.appearance.log_scales.half().numpy(),
            **heads,
            **{f"{_GLASS}{name}": table.numpy() for name, table in glass.items()},
        )

    @classmethod
    def load(cls, directory: Path) -> Liquid:
        """Read what `save` wrote. Raises SplashbenchError naming the file at fault."""
        path = directory / "liquid.json"
        header = read_json(path)
        try:
            if header["format"] not in (FORMAT, FORMAT_WITHOUT_GLASS):
                raise SplashbenchError(f"{path}: format {header['format']} is not {FORMAT}; fit the scene again")
            with_glass = header["format"] == FORMAT
            box = header["grid"]
            nx, ny, nz = (int(n) for n in box["shape"])
            grid = Grid(np.array(box["origin"], dtype=np.float64), float(box["voxel"]), (nx, ny, nz))
            times = np.array(header["times"], dtype=np.float64)
            factor, count = _factor(header["factor"]), int(header["carriers"])
            carried = bool(header["carried"])
            # Models of before there was a choice do not say.
            between: BetweenFrames = "forward" if header.get("between_frames") == "forward" else "both"
            composition: Composition = "together" if header.get("composition") == "together" else "over"
            decoder = Decoder(
                DecoderSettings(**{key.replace("colour", "color"): value for key, value in header["decoder"].items()})
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise SplashbenchError(f"{path} is not a SplashSplat model ({error}); fit the scene again") from None
        ranks = {"starts": 1, "ids": 1, "positions": 2, "deformation": 3, "phi": 1}
        rows = read_npz(directory / "carriers.npz", ranks)
        carriers = Carriers(
            starts=rows["starts"],
            ids=rows["ids"],
            positions=rows["positions"].astype(np.float32) / np.float32(_position_steps(grid)),
            deformation=rows["deformation"].astype(np.float32),
            phi=rows["phi"].astype(np.float32),
            count=count,
        )
        moves = read_npz(directory / "velocity.npz", {"velocities": 5, "jets": 2, "turn": 2})
        try:
            falls = falls_of(moves["jets"], moves["turn"], grid, times)
        except ValueError as error:
            raise SplashbenchError(
                f"{directory / 'velocity.npz'} does not fit liquid.json ({error}); fit the scene again"
            ) from None
        motion = Motion(moves["velocities"], factor, falls)
        phi = read_npz(directory / "phi.npz", {"phi": 4})["phi"]
        # Models of version 0.1 spell the heads "colour".
        british = "colour_width" in header["decoder"]
        heads = {name: f"heads.{name.replace('color', 'colour') if british else name}" for name in decoder.state_dict()}
        shapes = {heads[name]: value.ndim for name, value in decoder.state_dict().items()}
        panes = {f"{_GLASS}{name}": rank for name, rank in _GLASS_RANKS.items()} if with_glass else {}
        tables = read_npz(directory / "appearance.npz", {"features": 2, "log_scales": 2, **shapes, **panes})
        try:
            glass = Glass.of_tables({name: tables[f"{_GLASS}{name}"] for name in _GLASS_RANKS}) if with_glass else None
            decoder.load_state_dict({name: torch.from_numpy(tables[stored]) for name, stored in heads.items()})
        except (RuntimeError, ValueError):
            raise SplashbenchError(
                f"{directory / 'appearance.npz'} does not fit liquid.json; fit the scene again"
            ) from None
        appearance = Appearance(
            torch.from_numpy(tables["features"].astype(np.float32)),
            torch.from_numpy(tables["log_scales"].astype(np.float32)),
            decoder,
            glass,
        )
        return cls(times, grid, carriers, motion, phi, appearance, carried, composition, between)
