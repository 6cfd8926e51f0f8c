"""The pictures beside a result: truth, render and opacity of the test views at three moments, as one small JPEG.

`splashbench score` writes it beside the result's JSON, and the leaderboard's page shows it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_image, write_image
from splashbench.pages import data_uri
from splashbench.report.contact_sheet import spread_times
from splashbench.scene import Scene

_CELL_WIDTH = 200
_VIEWS = 2
_GAP = 3
_QUALITY = 80
_OUTLINE = (230, 159, 0)
#: A sheet has some 60 kB; larger ones are none of ours.
_MAX_BYTES, _MAX_PIXELS = 2 << 20, 8 << 20


def sheet_path(result: Path) -> Path:
    """Where the pictures of the result in the file `result` lie."""
    return result.with_suffix(".jpg")


def write_result_sheet(scene: Scene, submission: Any, result: Path) -> Path:
    """Draw the sheet of a finished `submission` of `scene` beside its `result`; returns its path.

    Rows: the truth, what was rendered, and the liquid's opacity with the true outline in orange. Columns: early, middle
    and late, of up to two test views.
    """
    columns = []
    for camera in scene.test[:_VIEWS]:
        for t in spread_times(scene):
            mask = scene.mask(camera, t)
            opacity = np.repeat(np.round(submission.alpha(camera, t) * 255).astype(np.uint8)[..., None], 3, axis=2)
            cells = [scene.image(camera, t), submission.rendering(camera, t), opacity]
            small = [_shrunk(cell) for cell in cells]
            _outline(small[2], mask)
            columns.append(np.concatenate([_framed(cell) for cell in small], axis=0))
    height = max(column.shape[0] for column in columns)
    padded = [np.pad(c, ((0, height - len(c)), (0, 0), (0, 0)), constant_values=255) for c in columns]
    path = sheet_path(result)
    write_image(path, np.concatenate(padded, axis=1), _QUALITY)
    return path


def embedded_sheet(result: Path) -> str | None:
    """The pictures beside the file `result` as an address that holds them; None where there are none of ours."""
    path = sheet_path(result)
    if not path.is_file() or path.is_symlink() or path.stat().st_size > _MAX_BYTES:
        return None
    try:
        width, height = image_size(path)
        if width * height > _MAX_PIXELS:
            return None
        read_image(path)
    except SplashbenchError:
        return None
    return data_uri(path.read_bytes(), "image/jpeg")


def _shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(1, round(image.shape[0] * _CELL_WIDTH / image.shape[1]))
    return np.ascontiguousarray(cv2.resize(image, (_CELL_WIDTH, height), interpolation=cv2.INTER_AREA))


def _outline(cell: NDArray[np.uint8], mask: NDArray[np.bool_]) -> None:
    small = cv2.resize(mask.astype(np.uint8) * 255, (cell.shape[1], cell.shape[0]), interpolation=cv2.INTER_AREA)
    contours, _ = cv2.findContours((small > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(cell, contours, -1, _OUTLINE, 1)


def _framed(cell: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.pad(cell, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=255)
