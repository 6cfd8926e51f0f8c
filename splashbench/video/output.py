"""Films to files, whole or not at all: where they may go, and what is written there."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from splashbench.errors import SplashbenchError
from splashbench.files import (
    atomic_directory,
    atomic_path,
    require_file_place,
    require_folder_place,
    require_unsealed_place,
    write_json,
)
from splashbench.progress import track
from splashbench.video.encoders import Encoder, PngFolder, encode_gif, encode_mp4, gif_rate
from splashbench.video.film import Film

#: What tells a folder of frames, with their times and what they show.
FRAMES = "frames.json"
#: Of the frame, captions included: x264 takes no more.
MAX_SIDE = 16_384
_ENDINGS = (".mp4", ".gif")
# Frames that wait for the encoder at most: memory does not grow with the video.
_WAITING = 2


def is_folder(out: Path) -> bool:
    """Whether `out`, which has no ending, is a folder of PNGs. Raises SplashbenchError for another ending."""
    ending = Path(out).suffix.lower()
    if ending and ending not in _ENDINGS:
        raise SplashbenchError(f"{out} ends in {ending}; give a name in .mp4 or .gif, or a folder's for PNGs")
    return not ending


def require_place(out: Path, replace: bool) -> None:
    """Raise SplashbenchError where no video can be written at `out`: asked before long work.

    replace: whether what is there may go.
    """
    folder = is_folder(out)
    require_unsealed_place(out)
    if folder:
        require_folder_place(out)
        if out.is_dir() and any(out.iterdir()) and not replace:
            raise SplashbenchError(f"{out} exists already; give another place, or --replace to replace it")
        return
    require_file_place(out, replace)


def rate_for(out: Path) -> Callable[[float], float]:
    """What makes of frames a second the nearest ones that a file like `out` can have."""
    return gif_rate if Path(out).suffix.lower() == ".gif" else lambda fps: fps


def write_video(film: Film, out: Path, replace: bool = False) -> None:
    """Write `film` to `out`, whole or not at all, with a bar on standard error.

    Args:
        out: a name in .mp4 or .gif, or without an ending: a folder of PNGs, with their times in `FRAMES`.
        replace: whether what is at `out` may go.

    Raises SplashbenchError where nothing can be written, or where the folder there is no earlier video.
    """
    waiting: deque[Future[None]] = deque()
    with (
        _encoder(film, Path(out), replace) as encoder,
        ThreadPoolExecutor(1, thread_name_prefix="splashbench-video") as pool,
    ):
        # Frames are rendered here, in the thread that has loaded the model, and encoded in another.
        for pixels in track(film.frames(), "video", total=len(film)):
            waiting.append(pool.submit(encoder.add, pixels))
            if len(waiting) > _WAITING:
                waiting.popleft().result()
        for future in waiting:
            future.result()


@contextmanager
def _encoder(film: Film, out: Path, replace: bool) -> Iterator[Encoder]:
    """What writes the frames of `film` to `out`."""
    require_place(out, replace)
    width, height = film.size
    if max(width, height) > MAX_SIDE:
        raise SplashbenchError(f"the video would be {width}x{height}, more than {MAX_SIDE} a side; give a --resize")
    if is_folder(out):
        keys = ("frames", "fps", "times")
        with atomic_directory(out, replace, holds=FRAMES, keys=keys, inputs=film.inputs) as staging:
            yield PngFolder(staging)
            write_json(staging / FRAMES, film.about())
        return
    encode = encode_gif if out.suffix.lower() == ".gif" else encode_mp4
    with atomic_path(out, replace) as temporary, encode(temporary, (width, height), film.timing.fps) as encoder:
        yield encoder
