"""Writing a scene in the released layout, plus scene.json. Images are streamed: one frame in memory at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench.files import atomic_path, write_image, write_json, write_model, write_png
from splashbench.progress import track
from splashbench.scene.camera import Camera
from splashbench.scene.layout import SceneMeta


def write_scene(
    directory: Path,
    *,
    cameras: Mapping[str, Camera],
    train: Sequence[str],
    test: Sequence[str],
    n_frames: int,
    frames: Iterable[tuple[str, int, NDArray[np.uint8], NDArray[np.bool_] | None]],
    meta: SceneMeta,
    initial_points: NDArray | None = None,
    container_masks: Mapping[str, NDArray[np.bool_]] | None = None,
    image_format: str = "png",
    shown: Collection[str] | None = None,
) -> None:
    """Write a scene into `directory` (made where absent; wrap in `files.atomic_directory` for all or nothing).

    Args:
        cameras: name -> Camera, of the images as written.
        train: camera names of the training split.
        test: camera names of the test split.
        n_frames: number of timesteps T.
        frames: yields (camera, t, image uint8 [H, W, 3], liquid mask [H, W]) once for each shown camera and timestep;
            None in place of all masks of a camera that has none.
        meta: scene.json; its `sizes` are filled in here.
        initial_points: [N, 7] x, y, z, r, g, b, seg, for init_pt_cld.npz.
        container_masks: name -> [H, W].
        image_format: "png" (lossless) or "jpg".
        shown: the cameras whose images are written; of the others only the calibration. All by default.
    """
    directory = Path(directory)
    shown = set(cameras if shown is None else shown)
    directory.mkdir(parents=True, exist_ok=True)
    written: set[tuple[str, int]] = set()
    for name, t, image, mask in track(frames, "writing the scene", total=n_frames * len(shown)):
        camera = cameras[name]
        size = (camera.height, camera.width)
        outline = size if mask is None else mask.shape
        if image.shape != (*size, 3) or outline != size:
            raise ValueError(f"camera {name}, frame {t}: image {image.shape} or mask {outline} is not {camera}")
        write_frame(directory, name, t, image, mask, image_format)
        written.add((name, t))
    if len(written) != n_frames * len(shown):
        raise ValueError(f"{len(written)} of {n_frames * len(shown)} images were given")
    for name, mask in (container_masks or {}).items():
        write_png(directory / "container_mask" / f"{name}.png", to_gray(mask))
    if initial_points is not None:
        with atomic_path(directory / "init_pt_cld.npz") as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, data=np.asarray(initial_points, dtype=np.float32))
    for split, names in (("train", train), ("test", test)):
        write_json(
            directory / f"{split}_meta.json",
            split_meta([cameras[name] for name in names], n_frames, image_format),
        )
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    write_model(directory / "scene.json", meta.model_copy(update={"sizes": sizes}))


def write_frame(
    directory: Path,
    camera: str,
    t: int,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    image_format: str = "png",
) -> None:
    """Write what `camera` shows at timestep `t`, uint8 [H, W, 3], and its liquid mask [H, W], if it has one."""
    write_image(directory / "ims" / camera / f"{t:06d}.{image_format}", image)
    if mask is not None:
        write_png(directory / "seg" / camera / f"{t:06d}.png", to_gray(mask))


def to_gray(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """`mask` [H, W] as files have it: 255 where it is true."""
    return np.where(mask, 255, 0).astype(np.uint8)


def split_meta(cameras: Sequence[Camera], n_frames: int, image_format: str) -> dict:
    """The content of a `*_meta.json`. The format has one image size; it is the largest, scene.json has them all."""
    return {
        "w": max(camera.width for camera in cameras),
        "h": max(camera.height for camera in cameras),
        "k": [[camera.K.tolist() for camera in cameras]] * n_frames,
        "w2c": [[camera.w2c.tolist() for camera in cameras]] * n_frames,
        "fn": [[f"{camera.name}/{t:06d}.{image_format}" for camera in cameras] for t in range(n_frames)],
    }
