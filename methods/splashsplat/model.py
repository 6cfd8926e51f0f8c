"""The liquid as fitted: carriers, motion, signed distance and appearance, with its files.

A liquid is made of what is stored of it, so that a loaded model renders the same image, bit for bit. storage/FORMAT.md
describes the files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.files import read_json, write_json
from splashbench.observe.grid import Grid
from splashbench.scene.geometry import MAX_BYTES, SignedDistance
from splashbench.scene.particles import Particles, even_share, most_particles
from splashbench.scene.velocity import VelocityField

from .appearance.decoder import Decoder, DecoderSettings
from .appearance.fitting import Appearance, Composition
from .appearance.sensitivity import Sensitivity
from .carriers.between import BetweenFrames
from .carriers.population import Carriers
from .carriers.precision import HIGHEST, Precision
from .carriers.subframe import Track, locate
from .fields.sparse_frames import Frames
from .motion.between import moved_distance
from .motion.steps import Motion
from .motion.velocity import Factor
from .storage.archives import AGAIN, FORMAT, UNCODED, Archives, Stated, fitting, read_archives
from .storage.earlier import EARLIER, UNSORTED, read_earlier
from .storage.looks import appearance_arrays, learned_values, read_appearance
from .storage.track import carrier_arrays, motion_arrays, read_track

#: Step in which values are stored where nothing is known of the photographs, of their spread.
UNKNOWN_STEP = 0.05
# Of a decoder and of control cells in voxels, before they are made: a header may ask for any size.
_WIDEST = 4096
# Nodes of the transport grid between those of a velocity field that is handed out: u_t is coarser still.
_NODES_APART = 2


def _factor(stored: int | list[float]) -> Factor:
    """Transport voxels per control cell, as liquid.json has them."""
    if not isinstance(stored, list):
        factor = int(stored)
        if not 0 < factor <= _WIDEST:
            raise ValueError(f"its factor is not between 1 and {_WIDEST}")
        return factor
    fx, fy, fz = (float(width) for width in stored)
    if not all(0 < width <= _WIDEST for width in (fx, fy, fz)):  # false for NaN as well
        raise ValueError(f"its factors are not above 0 and at most {_WIDEST}")
    return fx, fy, fz


@dataclass
class Liquid:
    """The dynamic foreground.

    times: [T] seconds. grid: the transport grid. carriers, motion: in the precision of the files. phi: int8 [T, nx, ny,
    nz], see `pack_signed_distance`. carried: whether the motion is what moved the carriers. composition: how it was
    fitted and is drawn: "over" an image of the background, or "together" with the background's Gaussians.
    between_frames: whose carriers are drawn there, see carriers/between.py. arrays: what is stored, by file and name,
    but phi; none of a model of an earlier version. precision: of what is stored of carriers and motion.
    """

    times: np.ndarray
    grid: Grid
    carriers: Carriers
    motion: Motion
    phi: Frames
    appearance: Appearance
    carried: bool = True
    composition: Composition = "over"
    between_frames: BetweenFrames = "both"
    arrays: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    precision: Precision = HIGHEST
    _surface: tuple[float, SignedDistance] | None = field(default=None, init=False, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        times: np.ndarray,
        track: Track,
        appearance: Appearance,
        carried: bool = True,
        composition: Composition = "over",
        between_frames: BetweenFrames = "both",
        sensitivity: Sensitivity | None = None,
        step: float = UNKNOWN_STEP,
    ) -> Liquid:
        """Bring the appearance to the precision of the files. track: in this precision already, see `stored_track`.

        sensitivity: of the photographs to the appearance; without it, values are stored in shares of their spread.
        step: see `store_values`.
        """
        known = Sensitivity.of_spread(learned_values(appearance)) if sensitivity is None else sensitivity
        arrays = {
            "carriers": carrier_arrays(track, track.carriers, carried),
            "motion": motion_arrays(track),
            "appearance": appearance_arrays(appearance, known, step, track.grid),
        }
        look = read_appearance(arrays["appearance"], Decoder(appearance.decoder.settings), track.grid)
        return cls._of_parts(times, track, look, carried, composition, between_frames, arrays)

    @classmethod
    def _of_parts(
        cls,
        times: np.ndarray,
        track: Track,
        appearance: Appearance,
        carried: bool,
        composition: Composition,
        between_frames: BetweenFrames,
        arrays: Mapping[str, Mapping[str, np.ndarray]],
    ) -> Liquid:
        carriers, motion = track.carriers, track.motion
        return cls(
            times,
            track.grid,
            carriers,
            motion,
            track.phi,
            appearance,
            carried,
            composition,
            between_frames,
            arrays,
            track.precision,
        )

    @property
    def track(self) -> Track:
        """The carriers at any time."""
        return Track(self.grid, self.carriers, self.motion, self.phi, self.precision)

    @property
    def handed_out(self) -> np.ndarray:
        """Numbers of the carriers that `particles` has, ascending, int64 [n]."""
        return even_share(self.carriers.count, most_particles(self.carriers.n_frames))

    def particles(self) -> Particles:
        """The carriers as particles, with the velocity of the liquid where they are, scene units per second.

        Without velocities where others than the model's moved them (the variants FLIP and per-frame). Where there are
        more than a file of particles may hold, an even share of them.
        """
        n_frames = self.carriers.n_frames
        number = np.full(self.carriers.count, -1, dtype=np.int64)
        handed_out = self.handed_out
        count = len(handed_out)
        number[handed_out] = np.arange(count)
        positions = np.zeros((n_frames, count, 3), dtype=np.float32)
        velocities = np.zeros_like(positions)
        active = np.zeros((n_frames, count), dtype=bool)
        for t in range(n_frames):
            rows = self.carriers.rows(t)
            ids = number[self.carriers.ids[rows]]
            x = self.carriers.positions[rows][ids >= 0]
            ids = ids[ids >= 0]
            positions[t, ids] = self.grid.to_scene(x)
            active[t, ids] = True
            if n_frames > 1 and len(ids):
                step = min(t, n_frames - 2)  # the last frame has no step of its own
                seconds = self.times[step + 1] - self.times[step]
                velocities[t, ids] = self.motion.step(step).velocity(x) * (self.grid.voxel / seconds)
        return Particles(positions, active, velocities if self.carried else None)

    def signed_distance(self) -> SignedDistance | None:
        """phi_t of every frame on the transport grid; None where that is more than a submission may hold."""
        return (
            None
            if self.phi.nbytes > MAX_BYTES
            else SignedDistance(np.asarray(self.phi), self.grid.origin, self.grid.voxel)
        )

    def surface(self, time: float) -> SignedDistance:
        """phi at `time` (seconds), one instant: each frame's around it moved there by u_t, blended by nearness."""
        # One instant's is asked for several times: for a picture, and for where a velocity is of the liquid.
        if self._surface is not None and self._surface[0] == time:
            return self._surface[1]
        t, fraction = locate(self.times, time)
        if fraction == 0:
            phi = self.phi[t]
        else:
            first, share = (t, fraction) if fraction > 0 else (t - 1, 1 + fraction)
            phi = moved_distance(self.phi[first], self.phi[first + 1], self.motion.step(first), share)
        surface = SignedDistance(phi[None], self.grid.origin, self.grid.voxel)
        self._surface = time, surface
        return surface

    def velocity(self, time: float) -> VelocityField | None:
        """u_t of the step that `time` (seconds) lies in, on every second node; None where it moved no carrier."""
        if not self.carried or len(self.times) < 2:
            return None
        t = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        nodes = np.stack(np.meshgrid(*(np.arange(0, n, _NODES_APART) for n in self.grid.shape), indexing="ij"), -1)
        per_second = self.grid.voxel / (self.times[t + 1] - self.times[t])
        values = self.motion.step(t).velocity(nodes.reshape(-1, 3).astype(np.float64)) * per_second
        liquid = self.surface(time).phi[0, ::_NODES_APART, ::_NODES_APART, ::_NODES_APART] < 0
        spacing = np.full(3, self.grid.voxel * _NODES_APART)
        return VelocityField(values.reshape(nodes.shape), self.grid.origin, spacing, liquid)

    @property
    def stored_bytes(self) -> int:
        """How much `save` writes, to within some kilobytes."""
        return Archives(self.arrays, self.phi).stored_bytes

    def save(self, directory: Path) -> None:
        """Write liquid.json and four .npz files into `directory`."""
        if not self.arrays:
            raise SplashbenchError(f"a model of an earlier version cannot be written again; {AGAIN}")
        header = {
            "format": FORMAT,
            "times": [float(t) for t in self.times],
            "grid": {
                "origin": [float(x) for x in self.grid.origin],
                "voxel": self.grid.voxel,
                "shape": list(self.grid.shape),
            },
            "steps": self.precision.steps,
            "factor": self.motion.factor,
            "carried": self.carried,
            "composition": self.composition,
            "between_frames": self.between_frames,
            "glass": self.appearance.glass is not None,
            "decoder": dict(vars(self.appearance.decoder.settings)),
        }
        write_json(directory / "liquid.json", header)
        Archives(self.arrays, self.phi).write(directory)

    @classmethod
    def load(cls, directory: Path) -> Liquid:
        """Read what `save` wrote. Raises SplashbenchError naming the file at fault."""
        path = directory / "liquid.json"
        header = read_json(path)
        try:
            if header["format"] not in (FORMAT, UNCODED, UNSORTED, *EARLIER):
                raise SplashbenchError(f"{path}: format {header['format']} is not {FORMAT}; {AGAIN}")
            box = header["grid"]
            nx, ny, nz = (int(n) for n in box["shape"])
            if min(nx, ny, nz) < 2:
                raise ValueError("the grid has less than two nodes along an axis")
            grid = Grid(np.array(box["origin"], dtype=np.float64), float(box["voxel"]), (nx, ny, nz))
            if not (grid.origin.shape == (3,) and np.isfinite(grid.origin).all() and 0 < grid.voxel < np.inf):
                raise ValueError("the grid's origin is not three numbers, or its voxel not above 0")
            times = np.array(header["times"], dtype=np.float64)
            if not (times.ndim == 1 and len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
                raise ValueError("its times are not finite and rising")
            factor, carried = _factor(header["factor"]), bool(header["carried"])
            # Models of before there was a choice do not say.
            between: BetweenFrames = "forward" if header.get("between_frames") == "forward" else "both"
            composition: Composition = "together" if header.get("composition") == "together" else "over"
            settings = DecoderSettings(
                **{key.replace("colour", "color"): value for key, value in header["decoder"].items()}
            )
            if not isinstance(settings.transmission, bool) or (settings.transmission and composition == "together"):
                raise ValueError("its transmission is not that of liquid over a background")
            if not np.isfinite([value for value in vars(settings).values() if isinstance(value, (int, float))]).all():
                raise ValueError("the decoder has numbers that are not finite")
            if not 1 <= max(settings.feature_size, settings.children, settings.color_width) <= _WIDEST:
                raise ValueError(f"the decoder's sizes are not between 1 and {_WIDEST}")
            decoder = Decoder(settings)
            precision = Precision.stored(header["steps"]) if header["format"] in (FORMAT, UNCODED) else HIGHEST
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError, RuntimeError) as error:
            raise SplashbenchError(f"{path} is not a SplashSplat model ({error}); {AGAIN}") from None
        if header["format"] in EARLIER:
            track, look = fitting(directory, lambda: read_earlier(directory, header, grid, times, factor, decoder))
            return cls._of_parts(times, track, look, carried, composition, between, {})
        stated = Stated(header["format"], (len(times), *grid.shape), carried, bool(header.get("glass")), decoder)
        read = read_archives(directory, stated)
        track = fitting(directory, lambda: read_track(read.arrays, read.phi, grid, times, factor, precision))
        values = read.arrays["appearance"]
        if (count := len(values["coarseness"])) != track.carriers.count:
            others = f"{count} carriers, not {track.carriers.count}"
            raise SplashbenchError(f"{directory / 'appearance.npz'} has {others}; {AGAIN}")
        look = fitting(directory / "appearance.npz", lambda: read_appearance(values, decoder, grid))
        return cls._of_parts(times, track, look, carried, composition, between, read.arrays)
