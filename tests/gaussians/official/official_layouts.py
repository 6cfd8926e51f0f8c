"""Output folders of the official codes, written from their published layouts; run, a stand-in for one of them."""

from __future__ import annotations

import json
import shutil
import struct
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_MOVING = ["x", "y", "z", "trbf_center", "trbf_scale", "nx", "ny", "nz", *(f"motion_{i}" for i in range(9))]
_SHAPED = ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
_HARMONICS = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
DEFORMABLE = ["x", "y", "z", "nx", "ny", "nz", *_HARMONICS, *_SHAPED]
_TURNING = [f"omega_{i}" for i in range(4)]
LITE = [*_MOVING, *(f"f_dc_{i}" for i in range(3)), *_SHAPED, *_TURNING]
FULL = [*_MOVING, *(f"f_dc_{i}" for i in range(6)), *_SHAPED, *_TURNING, *(f"f_t_{i}" for i in range(3))]
ANCHORS = ["x", "y", "z", "t", *(f"f_offset_{i}" for i in range(40)), *(f"f_anchor_feat_{i}" for i in range(32))]
ANCHORS += ["opacity", *(f"scale_{i}" for i in range(8)), *(f"rot_{i}" for i in range(4))]


def write_ply(path: Path, names: Sequence[str], rows: np.ndarray) -> None:
    """`rows` [N, len(names)] as plyfile writes them: little-endian floats after a header of text."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header = "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""])
    path.parent.mkdir(parents=True, exist_ok=True)
    body = b"".join(struct.pack(f"<{len(names)}f", *(float(number) for number in row)) for row in rows)
    path.write_bytes(header.encode("ascii") + body)


def write_arguments(out: Path, **values: object) -> None:
    """cfg_args: a Namespace as Python prints it, with lists and the like among the values."""
    everything = {"sh_degree": 3, "source_path": "/data, set/colmap_0", "save_iterations": [7000, 10000], **values}
    out.mkdir(parents=True, exist_ok=True)
    (out / "cfg_args").write_text("Namespace(" + ", ".join(f"{k}={v!r}" for k, v in everything.items()) + ")")


def write_deformable(out: Path, rows: np.ndarray, network: Mapping[str, np.ndarray], **arguments: object) -> None:
    """A model of Deformable-3DGS, and an earlier one that is not meant."""
    import torch

    for iteration, cloud in ((7000, rows[:1]), (20000, rows)):
        write_ply(out / f"point_cloud/iteration_{iteration}/point_cloud.ply", DEFORMABLE, cloud)
        weights = out / f"deform/iteration_{iteration}/deform.pth"
        weights.parent.mkdir(parents=True)
        torch.save({name: torch.from_numpy(np.float32(array)) for name, array in network.items()}, weights)
    write_arguments(out, **{"white_background": False, "is_blender": False, **arguments})


def write_spacetime(out: Path, rows: np.ndarray, decoder: Mapping[str, np.ndarray] | None, **arguments: object) -> None:
    """A model of SpacetimeGaussians; the lite one has no decoder."""
    import torch

    path = out / "point_cloud/iteration_25000/point_cloud.ply"
    write_ply(path, LITE if decoder is None else FULL, rows)
    if decoder is not None:
        torch.save({name: torch.from_numpy(np.float32(a)) for name, a in decoder.items()}, path.with_suffix(".pt"))
    write_arguments(out, **{"duration": 8, "loader": "technicolor", "rgbfunction": "sandwich", **arguments})


def write_scaffold(
    out: Path, rows: np.ndarray, heads: Mapping[str, Mapping[str, np.ndarray]], traced: bool = True, **arguments: object
) -> None:
    """A model of 4D-Scaffold-GS: heads that torch traced, as the code saves them, or weights alone."""
    import torch

    folder = out / "point_cloud/iteration_120000"
    write_ply(folder / "point_cloud.ply", ANCHORS, rows)
    for name, weights in heads.items():
        tensors = {key: torch.from_numpy(np.float32(array)) for key, array in weights.items()}
        if not traced:
            torch.save(tensors, folder / f"{name}.pt")
            continue
        last = {"opacity_mlp": torch.nn.Tanh(), "flow_mlp": torch.nn.Tanh(), "color_mlp": torch.nn.Sigmoid()}
        (hidden, inputs), outputs = tensors["0.weight"].shape, len(tensors["2.bias"])
        layers = [torch.nn.Linear(inputs, hidden), torch.nn.ReLU(True), torch.nn.Linear(hidden, outputs)]
        network = torch.nn.Sequential(*layers, *([last[name]] if name in last else []))
        network.load_state_dict(tensors)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.jit.trace(network.eval(), torch.rand(1, inputs)).save(folder / f"{name}.pt")
    given = {"appearance_dim": 0, "temporal_opacity": "ours", "use_flow": True, "hparam_beta": 4.0, "frame_ratio": 0.33}
    write_arguments(out, **{**given, "time_duration": [0.0, 10.0], "white_background": False, **arguments})


def scaffold_heads(rng: np.random.Generator, children: int = 10) -> dict[str, dict[str, np.ndarray]]:
    """The four heads with numbers of our own."""
    sizes = {"opacity_mlp": (32, 1), "cov_mlp": (32, 8), "color_mlp": (35, 3), "flow_mlp": (32, 3)}
    heads = {}
    for name, (inputs, outputs) in sizes.items():
        first, second = rng.normal(0, 0.3, (32, inputs)), rng.normal(0, 0.3, (outputs * children, 32))
        biases = rng.normal(0, 0.3, 32), rng.normal(0, 0.5, outputs * children)
        heads[name] = {"0.weight": first, "0.bias": biases[0], "2.weight": second, "2.bias": biases[1]}
    return {name: {key: np.float32(array) for key, array in weights.items()} for name, weights in heads.items()}


def deform_network(rng: np.random.Generator, synthetic: bool = False, scale: float = 0.1) -> dict[str, np.ndarray]:
    """DeformNetwork with numbers of our own; `scale` of what it moves."""
    times = 13 if synthetic else 21
    inputs = 63 + (30 if synthetic else times)
    shapes = {f"linear.{i}": (256, 256) for i in range(8)}
    shapes["linear.0"], shapes["linear.5"] = (256, inputs), (256, 256 + inputs)
    if synthetic:
        shapes |= {"timenet.0": (256, times), "timenet.2": (30, 256)}
    heads = {"gaussian_warp": (3, 256), "gaussian_rotation": (4, 256), "gaussian_scaling": (3, 256)}
    network = {}
    for name, (rows, columns) in (shapes | heads).items():
        spread = (scale if name in heads else 1.5) / np.sqrt(columns)
        network[f"{name}.weight"] = rng.normal(0, spread, (rows, columns))
        network[f"{name}.bias"] = rng.normal(0, 0.01, rows) * (scale if name in heads else 1)
    return {name: np.float32(array) for name, array in network.items()}


def points_of(export: Path, rng: np.random.Generator, count: int = 40) -> np.ndarray:
    """Gaussians of Deformable-3DGS at some of the export's points, as a training could leave them."""
    box = json.loads((export / "scene.json").read_text())
    points = rng.permutation(np.load(export / "points.npy"))[:count]
    rows = np.zeros((count, len(DEFORMABLE)))
    rows[:, :3] = (points - box["center"]) * box["scale"]
    rows[:, 6:9] = rng.normal(0, 0.5, (count, 3))
    rows[:, 9:54] = rng.normal(0, 0.05, (count, 45))
    rows[:, 54] = 1.0
    rows[:, 55:58] = np.log(0.02)
    rows[:, 58] = 1.0
    return rows


if __name__ == "__main__":
    # A stand-in for a training: SCENE, OUT, and a folder with what it is to leave in OUT.
    export, out, trained = map(Path, sys.argv[1:])
    from PIL import Image

    # Photographs of training views; those of test views may be black.
    assert any(Image.open(path).getextrema()[2][1] > 50 for path in export.rglob("*.png"))
    shutil.copytree(trained, out, dirs_exist_ok=True)
