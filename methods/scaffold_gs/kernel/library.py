"""The C interface of the anchors' kernel (api.h) as ctypes sees it."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_float, c_int32, c_int64, c_void_p
from pathlib import Path

from splashbench.native.library import CompiledKernel, Signature


class HeadsStruct(Structure):
    """SplashHeads; `weights` are the four pointers of each head."""

    _fields_ = (
        ("features", c_int32),
        ("children", c_int32),
        ("hidden", c_int32),
        ("shape_sees_direction", c_int32),
        ("base_color", c_int32),
        ("weights", c_void_p * 12),
    )


class AnchorsStruct(Structure):
    """SplashAnchors."""

    _fields_ = (
        ("count", c_int64),
        ("rows", c_void_p),
        ("features", c_void_p),
        ("offsets", c_void_p),
        ("log_scales", c_void_p),
        ("positions", c_void_p),
        ("eye", c_float * 3),
    )


class ChildrenStruct(Structure):
    """SplashChildren."""

    _fields_ = (
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
        ("scales", c_void_p),
    )


class AnchorGradientsStruct(Structure):
    """SplashAnchorGradients."""

    _fields_ = (
        ("features", c_void_p),
        ("offsets", c_void_p),
        ("log_scales", c_void_p),
        ("weights", c_void_p * 12),
    )


_FUNCTIONS: dict[str, Signature] = {
    "splash_anchors_kept": (c_int64, (POINTER(HeadsStruct), c_int64)),
    "splash_anchors": (
        c_int32,
        (POINTER(HeadsStruct), POINTER(AnchorsStruct), POINTER(ChildrenStruct), c_void_p, c_int32),
    ),
    "splash_anchors_backward": (
        c_int32,
        (
            POINTER(HeadsStruct),
            POINTER(AnchorsStruct),
            c_void_p,
            POINTER(ChildrenStruct),
            c_int32,
            POINTER(AnchorGradientsStruct),
        ),
    ),
}

KERNEL = CompiledKernel("scaffold_gs", Path(__file__).parent, abi_version=1, functions=_FUNCTIONS)
