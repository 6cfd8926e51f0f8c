"""Restyling against truth: a pour filmed with two dyes; fitted to the one, dyed as the other, compared with it.

    splashbench synth scene glass_tank amber --size 600x400 --timesteps 24 --dye amber
    splashbench synth scene glass_tank blue --size 600x400 --timesteps 24 --dye blue
    splashbench run splashsplat amber amber_fit
    python benchmarks/restyle.py amber_fit amber blue --dye blue

The figures are means over the test views' frames of the PSNR within the liquid's mask: of the liquid as it is, of the
liquid restyled, and, of the scene it was fitted to, of the fit itself, which is what restyling could reach at best.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import fmean, median

import numpy as np

import splashbench
from splashbench.dyes import dye_named
from splashbench.restyle import filmed_dye, restyled
from splashbench.scene import Scene

_LEAST_PIXELS = 64


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """dB within `mask`; image in [0, 1], truth uint8."""
    return float(-10 * np.log10(np.mean((image[mask] - truth[mask] / 255.0) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("submission", type=Path)
    parser.add_argument("filmed", type=Path, help="scene that it was fitted to")
    parser.add_argument("other", type=Path, help="the same pour with the other dye")
    parser.add_argument("--dye", required=True)
    parser.add_argument("--density", type=float, default=1.0)
    parser.add_argument("--every", type=int, default=3)
    arguments = parser.parse_args()
    reconstruction = splashbench.load(arguments.submission, scene=arguments.filmed)
    filmed, other = Scene.open(arguments.filmed), Scene.open(arguments.other)
    start = time.perf_counter()
    found = filmed_dye(reconstruction)
    seconds = time.perf_counter() - start
    print(
        f"dye found in {seconds:.1f} s: absorption {found.absorption.round(1)} per unit, interval "
        f"{found.interval.round(1).tolist()}, thick layers {found.returned.round(3)}, index {found.index}, "
        f"{'opaque' if found.opaque else 'seen through'}"
    )
    dyed = restyled(reconstruction, dye_named(arguments.dye), arguments.density, filmed=found)
    rows: dict[str, list[float]] = {"as it is": [], "restyled": [], "fit": []}
    took = []
    for name in reconstruction.test:
        for t in range(arguments.every - 1, filmed.n_frames, arguments.every):
            mask = other.mask(name, t)
            if mask.sum() < _LEAST_PIXELS:
                continue
            moment = float(reconstruction.camera_times[name][t])
            before = reconstruction.render(name, moment).rgb
            start = time.perf_counter()
            after = dyed.render(name, moment).rgb
            took.append(time.perf_counter() - start)
            rows["as it is"].append(psnr(before, other.image(name, t), mask))
            rows["restyled"].append(psnr(after, other.image(name, t), mask))
            rows["fit"].append(psnr(before, filmed.image(name, t), filmed.mask(name, t)))
    print(
        f"{len(took)} frames, {median(took):.2f} s each; dB: "
        + ", ".join(f"{k} {fmean(v):.2f}" for k, v in rows.items())
    )


if __name__ == "__main__":
    main()
