"""The compiled kernel: finds the library for this processor, and states its C interface (kernel/api.h) to ctypes.

The build makes a library for each kind of processor (kernel/libsplash_<variant>.so); the best one for this processor
is loaded. SPLASHBENCH_SIMD=<variant> asks for another, SPLASHBENCH_KERNEL=<path> for a library built elsewhere.
Variants round differently in the last digits, so a run's record names the one it used.
"""

from __future__ import annotations

import ctypes
import os
import sys
from ctypes import POINTER, Structure, c_char_p, c_double, c_float, c_int32, c_int64, c_void_p
from functools import lru_cache
from pathlib import Path

from splashbench.errors import SplashbenchError

ABI_VERSION = 2
MAX_CHANNELS = 32
MAX_THREADS = 64

DONE, NOT_FINITE, OUT_OF_MEMORY, TOO_LARGE = range(4)

_FOLDER = Path(__file__).parent / "kernel"
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_REBUILD = "install splashbench again (`pip install -e .` in a checkout)"


class Camera(Structure):
    """SplashCamera."""

    _fields_ = (
        ("world_to_camera", c_double * 12),
        ("fx", c_double),
        ("fy", c_double),
        ("cx", c_double),
        ("cy", c_double),
        ("width", c_int32),
        ("height", c_int32),
    )


class Gaussians(Structure):
    """SplashGaussians."""

    _fields_ = (
        ("count", c_int64),
        ("channels", c_int32),
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
    )


class Output(Structure):
    """SplashOutput."""

    _fields_ = (
        ("depth", c_int32),
        ("compact", c_int32),
        ("background_per_pixel", c_int32),
        ("modes", c_void_p),
        ("background", c_void_p),
        ("color", c_void_p),
        ("opacity", c_void_p),
    )


class Gradients(Structure):
    """SplashGradients."""

    _fields_ = (
        ("add", c_int32),
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
    )


class Heads(Structure):
    """SplashHeads."""

    _fields_ = (
        ("features", c_int32),
        ("children", c_int32),
        ("hidden", c_int32),
        ("offset_bound", c_float),
        ("scale_range", c_float),
        ("opacity_slope", c_float),
        ("opacity_band", c_float),
        ("separation_margin", c_float),
        ("weights", c_void_p * 10),
    )


class Carriers(Structure):
    """SplashCarriers."""

    _fields_ = (
        ("count", c_int64),
        ("rows", c_void_p),
        ("features", c_void_p),
        ("log_scales", c_void_p),
        ("positions", c_void_p),
        ("deformation", c_void_p),
        ("phi", c_void_p),
        ("visibility", c_void_p),
        ("eye", c_float * 3),
        ("cells", c_void_p),
        ("cell_count", c_int64),
    )


class Children(Structure):
    """SplashChildren."""

    _fields_ = (
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
        ("offsets", c_void_p),
    )


class DecoderGradients(Structure):
    """SplashDecoderGradients."""

    _fields_ = (("features", c_void_p), ("log_scales", c_void_p), ("weights", c_void_p * 10))


class RowAdam(Structure):
    """SplashRowAdam."""

    _fields_ = (
        ("table", c_void_p),
        ("first", c_void_p),
        ("second", c_void_p),
        ("steps", c_void_p),
        ("width", c_int64),
        ("corrections", c_void_p),
        ("beta1", c_double),
        ("beta2", c_double),
        ("epsilon", c_double),
    )


class Window(Structure):
    """SplashWindow."""

    _fields_ = (
        ("width", c_int32),
        ("height", c_int32),
        ("left", c_int32),
        ("top", c_int32),
        ("columns", c_int32),
        ("rows", c_int32),
        ("truth", c_void_p),
        ("mask", c_void_p),
    )


def _open(path: Path) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(os.fspath(path))
    except OSError as error:
        raise SplashbenchError(f"{path}: cannot load the renderer's kernel ({error}); {_REBUILD}") from None
    try:
        version = library.splash_abi_version()
    except AttributeError:
        version = None
    if version != ABI_VERSION:
        raise SplashbenchError(
            f"{path}: the renderer's kernel is of version {version}, this code needs {ABI_VERSION}; {_REBUILD}"
        )
    frame = c_void_p
    signatures: dict[str, tuple[object, tuple]] = {
        "splash_forward": (
            c_int32,
            (POINTER(Camera), POINTER(Gaussians), POINTER(Output), frame, c_int32, POINTER(frame)),
        ),
        "splash_freeze": (c_int32, (POINTER(Camera), POINTER(Gaussians), c_int32, c_int32, POINTER(frame))),
        "splash_backward": (c_int32, (frame, c_void_p, c_void_p, c_int32, POINTER(Gradients))),
        "splash_release": (None, (frame,)),
        "splash_frame_bytes": (c_int64, (frame,)),
        "splash_frame_counts": (None, (frame, c_int64 * 3)),
        "splash_decode_kept": (c_int64, (POINTER(Heads), c_int64)),
        "splash_decode": (
            c_int32,
            (POINTER(Heads), POINTER(Carriers), POINTER(Children), c_void_p, c_void_p, c_double * 3, c_int32),
        ),
        "splash_decode_backward": (
            c_int32,
            (
                POINTER(Heads),
                POINTER(Carriers),
                c_void_p,
                c_void_p,
                POINTER(Children),
                c_double * 3,
                c_int32,
                POINTER(DecoderGradients),
            ),
        ),
        "splash_adam_rows": (None, (POINTER(RowAdam), c_int64, c_void_p, c_void_p, c_float, c_int32)),
        "splash_window_losses": (c_int32, (POINTER(Window), c_void_p, c_void_p, c_double * 3, c_int32)),
        "splash_window_gradients": (
            c_int32,
            (POINTER(Window), c_void_p, c_void_p, c_double * 3, c_void_p, c_void_p, c_int32),
        ),
        "splash_trim": (None, ()),
        "splash_variant": (c_char_p, ()),
        "splash_best_variant": (c_char_p, ()),
        "splash_runs": (c_int32, (c_char_p,)),
        "splash_tile_width": (c_int32, ()),
        "splash_tile_height": (c_int32, ()),
        "splash_constants": (None, (c_double * 6,)),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def built_variants() -> list[str]:
    """The variants that this installation holds, such as ["avx2", "baseline"]."""
    return sorted(path.stem.removeprefix("libsplash_") for path in _FOLDER.glob(f"libsplash_*{_SUFFIX}"))


def _plain() -> ctypes.CDLL:
    """The variant that every processor of its kind runs, and that knows about the others."""
    return _open(_path("neon" if "neon" in built_variants() else "baseline"))


def _path(variant: str) -> Path:
    path = _FOLDER / f"libsplash_{variant}{_SUFFIX}"
    if not path.exists():
        built = ", ".join(built_variants()) or "none"
        raise SplashbenchError(f"{path}: there is no such kernel of the renderer (built: {built}); {_REBUILD}")
    return path


def runs(variant: str) -> bool:
    """Whether this processor runs a variant."""
    return bool(_plain().splash_runs(variant.encode()))


def open_variant(variant: str) -> ctypes.CDLL:
    """The library of one variant. Raises SplashbenchError where there is none, or this processor does not run it."""
    path = _path(variant)
    if not runs(variant):
        raise SplashbenchError(f"{path}: this processor does not run it; unset SPLASHBENCH_SIMD")
    return _open(path)


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The kernel that this process uses. Raises SplashbenchError where there is none."""
    path = os.environ.get("SPLASHBENCH_KERNEL", "")
    if path:
        return _open(Path(path))
    wanted = os.environ.get("SPLASHBENCH_SIMD", "")
    if wanted:
        return open_variant(wanted)
    best = _plain().splash_best_variant().decode()
    return open_variant(best) if best in built_variants() else _plain()


def variant(of: ctypes.CDLL | None = None) -> str:
    """The name of a library's variant; by default of the one in use."""
    return str((of or library()).splash_variant().decode())
