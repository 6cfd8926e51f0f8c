"""The C interface of SplashSplat's own kernel (api.h) as ctypes sees it."""

from __future__ import annotations

from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_int64, c_void_p
from pathlib import Path

from splashbench.native.library import CompiledKernel, Signature


class HeadsStruct(Structure):
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


class CarriersStruct(Structure):
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


class ChildrenStruct(Structure):
    """SplashChildren."""

    _fields_ = (
        ("means", c_void_p),
        ("factors", c_void_p),
        ("opacities", c_void_p),
        ("colors", c_void_p),
        ("offsets", c_void_p),
    )


class DecoderGradientsStruct(Structure):
    """SplashDecoderGradients."""

    _fields_ = (("features", c_void_p), ("log_scales", c_void_p), ("weights", c_void_p * 10))


class RowAdamStruct(Structure):
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


MAX_LEVELS = 8


class SharedRowsStruct(Structure):
    """SplashSharedRows."""

    _fields_ = (
        ("width", c_int64),
        ("own", c_void_p),
        ("levels", c_int32),
        ("tables", c_void_p * MAX_LEVELS),
        ("cells", c_void_p * MAX_LEVELS),
    )


class WindowStruct(Structure):
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


class DescentStruct(Structure):
    """SplashDescent."""

    _fields_ = (
        ("shape", c_int32 * 3),
        ("control_shape", c_int32 * 3),
        ("factor", c_float * 3),
        ("step", c_float),
        ("before", c_void_p),
        ("after", c_void_p),
        ("control", c_void_p),
        ("cells", c_int64),
        ("starts", c_void_p),
        ("nodes", c_void_p),
    )


_FUNCTIONS: dict[str, Signature] = {
    "splash_decode_kept": (c_int64, (POINTER(HeadsStruct), c_int64)),
    "splash_decode": (
        c_int32,
        (
            POINTER(HeadsStruct),
            POINTER(CarriersStruct),
            POINTER(ChildrenStruct),
            c_void_p,
            c_void_p,
            c_double * 3,
            c_int32,
        ),
    ),
    "splash_decode_backward": (
        c_int32,
        (
            POINTER(HeadsStruct),
            POINTER(CarriersStruct),
            c_void_p,
            c_void_p,
            POINTER(ChildrenStruct),
            c_double * 3,
            c_int32,
            POINTER(DecoderGradientsStruct),
        ),
    ),
    "splash_adam_rows": (None, (POINTER(RowAdamStruct), c_int64, c_void_p, c_void_p, c_float, c_int32)),
    "splash_sum_rows": (None, (POINTER(SharedRowsStruct), c_int64, c_void_p, c_void_p, c_int32)),
    "splash_add_by_member": (None, (c_int64, c_int64, c_void_p, c_void_p, c_void_p, c_int64, c_void_p)),
    "splash_code_begin": (c_void_p, (c_void_p, c_int64)),
    "splash_code_end": (None, (c_void_p,)),
    "splash_code_table": (c_int32, (c_void_p, c_void_p, c_int64, c_int32, c_int32)),
    "splash_code_field": (c_int32, (c_void_p, c_void_p, c_int64 * 5)),
    "splash_code_frame": (c_int32, (c_void_p, c_void_p, c_void_p, c_void_p, c_int64 * 3, c_int32, c_int32)),
    "splash_code_finish": (c_int64, (c_void_p,)),
    "splash_code_copy": (None, (c_void_p, c_void_p)),
    "splash_descend": (None, (POINTER(DescentStruct), c_void_p, c_void_p, c_int32)),
    "splash_window_losses": (c_int32, (POINTER(WindowStruct), c_void_p, c_void_p, c_double * 3, c_int32)),
    "splash_window_gradients": (
        c_int32,
        (POINTER(WindowStruct), c_void_p, c_void_p, c_double * 3, c_void_p, c_void_p, c_int32),
    ),
}

KERNEL = CompiledKernel("splashsplat", Path(__file__).parent, abi_version=4, functions=_FUNCTIONS)
