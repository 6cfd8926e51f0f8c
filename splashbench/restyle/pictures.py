"""A restyled liquid as files: pictures, for compositors the buffers they were made of, and the dyes in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.files import atomic_directory, write_json, write_png
from splashbench.progress import track
from splashbench.replay import Reconstruction
from splashbench.restyle.filmed_dye import FilmedDye
from splashbench.restyle.relighting import Buffers, Restyled, metres_per_unit
from splashbench.srgb import hex_color, to_srgb
from splashbench.submission import to_8bit
from splashbench.submission.exr import write_channels

#: What marks a folder as one of these, which may be replaced.
DYE_FILE = "dye.json"


def write_restyled(
    dyed: Reconstruction,
    out: Path,
    cameras: Sequence[str],
    *,
    facts: dict[str, Any] | None = None,
    exr: bool = False,
    replace: bool = False,
) -> int:
    """Write OUT/<camera>/<frame>.png of `cameras` at every timestep, and dye.json; returns how many frames.

    Args:
        dyed: as `restyled` returns it.
        facts: what stands in dye.json besides the filmed dye.
        exr: write OUT/exr/<camera>/<frame>.exr too, see `write_buffers`.
    """
    model = dyed.fitted
    assert isinstance(model, Restyled)
    views = [(name, t) for name in cameras for t in range(len(dyed.times))]
    inputs = [dyed.submission.directory]
    with atomic_directory(out, replace, holds=DYE_FILE, keys=("filmed",), inputs=inputs) as staging:
        for name, t in track(views, "restyling", total=len(views)):
            buffers = model.buffers(dyed.cameras[name], float(dyed.camera_times[name][t]))
            (staging / name).mkdir(exist_ok=True)
            write_png(staging / name / f"{t:06d}.png", to_8bit(to_srgb(buffers.rgb)))
            if exr:
                folder = staging / "exr" / name
                folder.mkdir(parents=True, exist_ok=True)
                write_buffers(folder / f"{t:06d}.exr", buffers)
        write_json(staging / DYE_FILE, {**(facts or {}), "filmed": filmed_facts(dyed, model.filmed)})
    return len(views)


def write_buffers(path: Path, buffers: Buffers) -> None:
    """Write one frame's buffers as an OpenEXR of several layers.

    Channels: R G B (linear light, liquid and background together) and A (the liquid's opacity) as half floats;
    `background.R/G/B` likewise; `depth.Z` along the optical axis and `length.Z` within the liquid, scene units, and
    `normal.X/Y/Z` in the scene's axes, as floats. Where no liquid is met, depth is infinite and the others are 0.
    """
    half = {
        **{name: buffers.rgb[..., c] for c, name in enumerate("RGB")},
        "A": buffers.alpha,
        **{f"background.{name}": buffers.background[..., c] for c, name in enumerate("RGB")},
    }
    full = {
        "depth.Z": buffers.interface.depth,
        "length.Z": buffers.interface.length,
        **{f"normal.{name}": buffers.interface.normal[..., c] for c, name in enumerate("XYZ")},
    }
    channels = {name: np.ascontiguousarray(values, np.float16) for name, values in half.items()}
    channels |= {name: np.ascontiguousarray(values, np.float32) for name, values in full.items()}
    write_channels(path, channels)


def filmed_facts(reconstruction: Reconstruction, filmed: FilmedDye) -> dict[str, Any]:
    """The filmed dye in numbers that JSON has: absorption per metre, what it is by eye, and how it was told.

    Of an opaque liquid the absorption is null: `at_least` is what the photographs allow.
    """
    per_metre = 1 / metres_per_unit(reconstruction, filmed)
    low, high = (filmed.interval * per_metre).round(2).tolist()
    return {
        "opaque": filmed.opaque,
        "absorption_per_metre": None if filmed.opaque else (filmed.absorption * per_metre).round(2).tolist(),
        "absorption_low": None if filmed.opaque else low,
        "absorption_high": None if filmed.opaque else high,
        "absorption_at_least": low if filmed.opaque else None,
        "thick_layers": hex_color(to_srgb(filmed.returned)),
        "refractive_index": filmed.index,
        "metric": reconstruction.metres_per_unit is not None,
    }
