"""How long the losses of one rendered window take, forward and backward, and what SSIM is of that.

    python benchmarks/losses.py [--sides 160 400 1000] [--rounds 15] [--json FILE]

window     foreground, gradient and silhouette by splashsplat's kernel, ms
+ SSIM     the same with SSIM by the kernel of splashbench.gaussians, ms
by torch   SSIM alone by torch's convolutions on the same processor, ms
ratio      by torch over what SSIM adds to the window

Square windows of random colours. The three take turns, and figures are medians over rounds; one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from splashbench.files import write_text
from splashbench.gaussians.ssim import ssim_by_torch
from splashbench.native.threads import use_threads
from splashbench_methods.splashsplat.kernel.window_loss import WindowPhotograph, window_losses


def passes(side: int) -> dict[str, Callable[[], object]]:
    """What is timed, on a window of `side` pixels."""
    torch.manual_seed(0)
    image, alpha = (torch.rand(shape).requires_grad_() for shape in ((side, side, 3), (side, side)))
    colors = (255 * torch.rand(side, side, 3)).to(torch.uint8)
    photograph = WindowPhotograph(colors, torch.rand(side, side) > 0.5, top=0, left=0)
    truth = (colors / 255).permute(2, 0, 1).contiguous()

    def window(with_ssim: bool) -> tuple[Tensor, ...]:
        terms = window_losses(image, alpha, photograph, with_ssim)
        total = sum(term for term in terms if term is not None)
        return torch.autograd.grad(total, [image, alpha])

    return {
        "window": lambda: window(False),
        "+ SSIM": lambda: window(True),
        "by torch": lambda: torch.autograd.grad(ssim_by_torch(image, truth), image),
    }


def measure(side: int, rounds: int) -> dict[str, float]:
    """Milliseconds by pass, medians over `rounds`, and the ratio."""
    timed = passes(side)
    spent: dict[str, list[float]] = {name: [] for name in timed}
    for number in range(rounds + 1):
        for name, run in timed.items():
            start = time.perf_counter()
            run()
            if number > 0:  # the first round finds no memory to use again
                spent[name].append(1e3 * (time.perf_counter() - start))
    found = {name: median(values) for name, values in spent.items()}
    found["ratio"] = median(
        torch_ms / max(both - alone, 1e-6)
        for alone, both, torch_ms in zip(spent["window"], spent["+ SSIM"], spent["by torch"])
    )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sides", type=int, nargs="+", default=[160, 400, 1000], metavar="PIXELS")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    arguments = parser.parse_args()
    if arguments.rounds < 1 or min(arguments.sides) < 1:
        parser.error("--rounds and --sides have to be 1 or more")
    torch.set_num_threads(1)
    table = {}
    with use_threads(1):
        for side in arguments.sides:
            table[side] = measure(side, arguments.rounds)
            print(f"{side} px  " + "  ".join(f"{name} {value:.2f}" for name, value in table[side].items()), flush=True)
    if arguments.json is not None:
        write_text(arguments.json, json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
