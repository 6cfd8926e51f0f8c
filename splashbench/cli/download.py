"""`splashbench download lpips-weights`: fetch what is needed and not ours to ship, once."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from splashbench.cli.command import add_command, add_group
from splashbench.cli.output import emit, say

_EXAMPLES = """\
examples:
  splashbench download lpips-weights
  splashbench download lpips-weights --to weights            then score with --lpips-weights, or the variable
  splashbench download lpips-weights --from Downloads        the two files fetched by other means
"""

_LPIPS = """
AlexNet's weights come from torchvision (alexnet-owt-7be5be79.pth, 244 MB) and the linear weights from the authors of
LPIPS (alex.pth, 6 kB). Nothing in them is run; what is needed of them is verified and stays as one .npz of 10 MB. It
lies in the folder SPLASHBENCH_CACHE, else XDG_CACHE_HOME/splashbench, else ~/.cache/splashbench, where `score` and
`study` find it. An interrupted download goes on where it stopped. Proxies are taken from https_proxy.
"""


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    actions = add_group(
        subparsers,
        "download",
        summary="fetch the weights of LPIPS, once",
        description="Fetch public files that are needed and not ours to ship, once, and verify them.",
        epilog=_EXAMPLES,
    )
    parser = add_command(
        actions,
        "lpips-weights",
        lpips_weights,
        summary="the network weights of LPIPS; without them it is null",
        description="Fetch the network weights of the metric LPIPS. Where they are there and verified, do nothing.",
        epilog=_EXAMPLES + _LPIPS,
    )
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="keep them here (default: the cache folder)")
    parser.add_argument(
        "--from",
        type=Path,
        dest="by_hand",
        metavar="FOLDER",
        help="take alexnet-owt-7be5be79.pth and alex.pth from this folder; no network is needed",
    )


def lpips_weights(arguments: argparse.Namespace) -> int:
    """Handle `splashbench download lpips-weights`."""
    from splashbench.download.lpips_weights import download_lpips_weights
    from splashbench.processes import Terminated
    from splashbench.score.image.weights import WEIGHTS_SHA256

    try:
        path, made = download_lpips_weights(arguments.to, arguments.by_hand, tell=say)
    except KeyboardInterrupt as error:
        say("\ninterrupted; the same command goes on where it stopped")
        return 128 + (error.signum if isinstance(error, Terminated) else signal.SIGINT)
    say(f"wrote {path}, verified" if made else f"{path} is there and verified; nothing to do")
    if arguments.to:
        say(f"score with --lpips-weights {path}, or set SPLASHBENCH_LPIPS_WEIGHTS to it")
    if arguments.json:
        emit({"weights": str(path), "sha256": WEIGHTS_SHA256, "made": made})
    return 0
