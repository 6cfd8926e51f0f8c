"""The renderer's C interface (kernel/api.h) as ctypes sees it."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_int32, c_int64, c_void_p
from pathlib import Path

from splashbench.native.library import CompiledKernel, Signature

ABI_VERSION = 4
MAX_CHANNELS = 32


class CameraStruct(Structure):
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


class GaussiansStruct(Structure):
    """SplashGaussians."""

    _fields_ = (
        ("count", c_int64),
        ("channels", c_int32),
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
    )


class OutputStruct(Structure):
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


class GradientsStruct(Structure):
    """SplashGradients."""

    _fields_ = (
        ("add", c_int32),
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
    )


_FRAME = c_void_p
_FUNCTIONS: dict[str, Signature] = {
    "splash_forward": (
        c_int32,
        (POINTER(CameraStruct), POINTER(GaussiansStruct), POINTER(OutputStruct), _FRAME, c_int32, POINTER(_FRAME)),
    ),
    "splash_freeze": (c_int32, (POINTER(CameraStruct), POINTER(GaussiansStruct), c_int32, c_int32, POINTER(_FRAME))),
    "splash_backward": (c_int32, (_FRAME, c_void_p, c_void_p, c_int32, POINTER(GradientsStruct))),
    "splash_weigh": (
        c_int32,
        (POINTER(CameraStruct), POINTER(GaussiansStruct), c_void_p, _FRAME, c_int32, c_void_p),
    ),
    "splash_release": (None, (_FRAME,)),
    "splash_frame_bytes": (c_int64, (_FRAME,)),
    "splash_frame_counts": (None, (_FRAME, c_int64 * 3)),
    "splash_trim": (None, ()),
    "splash_tile_width": (c_int32, ()),
    "splash_tile_height": (c_int32, ()),
    "splash_constants": (None, (c_double * 6,)),
}

KERNEL = CompiledKernel("render", Path(__file__).parent / "kernel", ABI_VERSION, _FUNCTIONS)
