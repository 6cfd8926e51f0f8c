"""Where screenshots and camera paths go: to the browser, as a download, or into a folder that the user named."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path
from splashbench.scene import Camera


def save(folder: Path | None, client: Any, name: str, ending: str, content: bytes) -> str:
    """Write `content` into `folder` under `name` with the first number that is free, or have `client` download it.

    Returns a sentence on where it is.
    """
    if folder is None:
        client.send_file_download(f"{name}{ending}", content, save_immediately=True)
        return f"The browser saves it as {name}{ending}."
    path = _unused(folder, name, ending)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return f"Saved as {path}."


def _unused(folder: Path, name: str, ending: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    taken = {path.name for path in folder.iterdir()}
    number = 1
    while f"{name}_{number:03d}{ending}" in taken:
        number += 1
    return folder / f"{name}_{number:03d}{ending}"


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """`image` [H, W, 3] as PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def camera_path_bytes(cameras: Sequence[Camera], times: Sequence[float], fps: float) -> bytes:
    """A camera path as nerfstudio has it."""
    from splashbench.replay.paths import write_camera_path

    with tempfile.TemporaryDirectory(prefix="splashbench-") as scratch:
        path = Path(scratch, "camera_path.json")
        write_camera_path(path, cameras, times, fps)
        return path.read_bytes()
