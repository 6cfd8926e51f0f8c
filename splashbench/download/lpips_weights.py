"""The weights of LPIPS: two public files are fetched, and one .npz of the 10 MB that are needed stays.

They are torchvision's AlexNet (IMAGENET1K_V1), and the linear weights of LPIPS v0.1 (Zhang et al. 2018). Neither is
ours to ship. Nothing in them is run, and what was taken from them is held against one digest.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splashbench.download.fetch import PATIENT, Patience, RemoteFile, alone, fetch
from splashbench.download.meter import megabytes
from splashbench.errors import SplashbenchError
from splashbench.files import atomic_path, require_file_place
from splashbench.score.image.weights import (
    ALEXNET_FILE,
    HEADS_FILE,
    WEIGHTS_SHA256,
    Weights,
    checkpoint_weights,
    verified_weights,
    weights_digest,
    weights_path,
)

_SCRATCH = ".lpips-weights"
# Torchvision's name for the file has the first digits of its SHA-256.
_ALEXNET = RemoteFile(
    f"https://download.pytorch.org/models/{ALEXNET_FILE}",
    244_408_911,
    "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
)
_HEADS = RemoteFile(
    f"https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/{HEADS_FILE}",
    6_009,
    "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
)


@dataclass(frozen=True)
class Sources:
    """Where the two files come from: torchvision and the authors of LPIPS, or a copy of both."""

    alexnet: RemoteFile = _ALEXNET
    heads: RemoteFile = _HEADS


OFFICIAL = Sources()


def download_lpips_weights(
    folder: Path | None = None,
    by_hand: Path | None = None,
    *,
    tell: Callable[[str], None],
    sources: Sources = OFFICIAL,
    patience: Patience = PATIENT,
) -> tuple[Path, bool]:
    """The .npz of the weights, and whether it was made now. One that is there and verified stays as it is.

    Args:
        folder: where the .npz goes; None is the cache folder, where `score` looks.
        by_hand: a folder with the two files, which somebody fetched by other means; nothing is fetched then.
        tell: takes lines for people.

    Raises SplashbenchError where a file cannot be had, is damaged, or holds other weights; nothing is kept then, but
    for what an interrupted download can go on from.
    """
    target = weights_path(folder)
    require_file_place(target)
    if verified_weights(target) is not None:
        return target, False
    with alone(target, tell):
        if verified_weights(target) is not None:  # another process has made it meanwhile
            return target, False
        if target.exists():
            tell(f"{target} is damaged, or holds other weights: it is made anew")
        scratch = target.parent / _SCRATCH
        try:
            if by_hand is None:
                weights = _fetched(scratch, sources, patience, tell)
            else:
                weights = _checked(_given(by_hand, sources.alexnet), _given(by_hand, sources.heads))
            _write(weights, target)
            shutil.rmtree(scratch, ignore_errors=True)
        finally:
            with suppress(OSError):  # something to go on from is in it
                scratch.rmdir()
    return target, True


def _fetched(scratch: Path, sources: Sources, patience: Patience, tell: Callable[[str], None]) -> Weights:
    """The weights of both files, which stay in `scratch` only where they are good."""
    remedy = (
        f"check the network, or fetch {sources.alexnet.url} and {sources.heads.url} by other means into one folder, "
        "and give it by --from FOLDER"
    )
    files = (sources.heads, sources.alexnet)  # the small one first: without a network there is no long wait
    tell(f"fetching {' and '.join(f'{file.url} ({megabytes(file.size)})' for file in files)}")
    for file in files:
        fetch(file, scratch / file.name, remedy=remedy, patience=patience)
    try:
        return _checked(scratch / sources.alexnet.name, scratch / sources.heads.name)
    except SplashbenchError:
        shutil.rmtree(scratch, ignore_errors=True)
        raise


def _given(folder: Path, file: RemoteFile) -> Path:
    """The path of a file that was fetched by hand. Raises SplashbenchError where it is missing."""
    path = Path(folder) / file.name
    if not path.is_file():
        raise SplashbenchError(f"{path} does not exist; fetch it from {file.url}")
    return path


def _checked(alexnet: Path, heads: Path) -> Weights:
    """The weights of both files. Raises SplashbenchError for others than those of AlexNet and LPIPS v0.1."""
    weights = checkpoint_weights(alexnet, heads)
    if weights_digest(weights) != WEIGHTS_SHA256:
        raise SplashbenchError(
            f"{alexnet} and {heads} hold other weights than those of LPIPS v0.1 with AlexNet, nothing was kept; "
            "fetch both files anew"
        )
    return weights


def _write(weights: Weights, target: Path) -> None:
    # Uncompressed: such numbers hardly get smaller, and `score` reads them at every start.
    arrays: dict[str, Any] = {**weights}
    with atomic_path(target) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **arrays)
