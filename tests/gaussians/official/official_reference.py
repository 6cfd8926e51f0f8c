"""The published formulas of the official codes in float64, pixel by pixel, as far from our renderer as can be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Gaussian(NamedTuple):
    """As the rasterizer gets it, in the code's units."""

    mean: np.ndarray
    covariance: np.ndarray
    opacity: float
    channels: np.ndarray


class Lens(NamedTuple):
    """width, height, focal lengths and principal point in pixels; R, t: world to camera, in the code's units.

    slopes: tangents of half the angles of view that footprints are projected with, where they are not the lens's own.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    R: np.ndarray
    t: np.ndarray
    slopes: tuple[float, float] | None = None


def matrix(q: np.ndarray) -> np.ndarray:
    """Of a quaternion (r x y z) that nobody has normalised, as the published kernel has it."""
    r, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y)],
            [2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x)],
            [2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def covariance(scales: np.ndarray, q: np.ndarray) -> np.ndarray:
    R = matrix(q)
    return R @ np.diag(scales**2) @ R.T


def footprint(mean: np.ndarray, cov: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray, float]:
    """Place in pixels, covariance in pixels^2, depth."""
    x, y, z = lens.R @ mean + lens.t
    tan_x, tan_y = lens.slopes or (lens.width / (2 * lens.fx), lens.height / (2 * lens.fy))
    focal_x, focal_y = lens.width / (2 * tan_x), lens.height / (2 * tan_y)
    a = min(1.3 * tan_x, max(-1.3 * tan_x, x / z))
    b = min(1.3 * tan_y, max(-1.3 * tan_y, y / z))
    J = np.array([[focal_x / z, 0, -focal_x * a / z], [0, focal_y / z, -focal_y * b / z]])
    flat = J @ lens.R @ cov @ lens.R.T @ J.T + 0.3 * np.eye(2)
    return np.array([lens.fx * x / z + lens.cx - 0.5, lens.fy * y / z + lens.cy - 0.5]), flat, z


def draw(gaussians: Sequence[Gaussian], lens: Lens, background: float = 0.0) -> np.ndarray:
    """[H, W, C]: front to back, alpha from 1/255 to 0.99, nothing nearer than 0.2."""
    drawn = []
    for g in gaussians:
        if (lens.R @ g.mean + lens.t)[2] > 0.2:
            place, flat, depth = footprint(g.mean, g.covariance, lens)
            drawn.append((depth, place, np.linalg.inv(flat), g))
    drawn.sort(key=lambda entry: entry[0])
    image = np.empty((lens.height, lens.width, len(gaussians[0].channels)))
    for row in range(lens.height):
        for column in range(lens.width):
            left, color = 1.0, np.zeros(image.shape[2])
            for _, place, conic, g in drawn:
                dx, dy = place[0] - column, place[1] - row
                power = -0.5 * (conic[0, 0] * dx * dx + conic[1, 1] * dy * dy) - conic[0, 1] * dx * dy
                alpha = min(0.99, g.opacity * math.exp(power))
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) < 1e-4:
                    break
                color += g.channels * (alpha * left)
                left *= 1 - alpha
            image[row, column] = color + left * background
    return image


def sigmoid(x: np.ndarray | float) -> np.ndarray | float:
    return 1 / (1 + np.exp(-np.asarray(x, float)))


def octaves(values: np.ndarray, count: int) -> np.ndarray:
    parts = [values]
    for k in range(count):
        parts += [np.sin(2.0**k * values), np.cos(2.0**k * values)]
    return np.concatenate(parts)


def deform(network: Mapping[str, np.ndarray], x: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """DeformNetwork of Deformable-3DGS: dx, dr, ds."""

    def linear(name: str, h: np.ndarray) -> np.ndarray:
        return network[f"{name}.weight"].astype(float) @ h + network[f"{name}.bias"]

    if "timenet.0.weight" in network:
        time = linear("timenet.2", np.maximum(linear("timenet.0", octaves(np.array([t]), 6)), 0))
    else:
        time = octaves(np.array([t]), 10)
    inputs = np.concatenate([octaves(x, 10), time])
    h = inputs
    for i in range(8):
        h = np.maximum(linear(f"linear.{i}", h), 0)
        if i == 4:
            h = np.concatenate([inputs, h])
    return linear("gaussian_warp", h), linear("gaussian_rotation", h), linear("gaussian_scaling", h)


def harmonics(d: np.ndarray) -> np.ndarray:
    """The 16 functions with the numbers of the published kernel."""
    x, y, z = d
    c2, c3 = 1.0925484305920792, (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154)
    return np.array(
        [
            0.28209479177387814,
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            c2 * x * y,
            -c2 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -c2 * x * z,
            0.5462742152960396 * (x * x - y * y),
            -c3[0] * y * (3 * x * x - y * y),
            c3[1] * x * y * z,
            -c3[2] * y * (4 * z * z - x * x - y * y),
            c3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c3[2] * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -c3[0] * x * (x * x - 3 * y * y),
        ]
    )


def deformable_at(row: Mapping[str, float], network: Mapping[str, np.ndarray], t: float, eye: np.ndarray) -> Gaussian:
    """A row of Deformable-3DGS's cloud at time t, seen from `eye`, in the code's units."""
    x = np.array([row[name] for name in "xyz"])
    dx, dr, ds = deform(network, x, t)
    q = np.array([row[f"rot_{i}"] for i in range(4)])
    q = q / np.linalg.norm(q) + dr
    scales = np.exp([row[f"scale_{i}"] for i in range(3)]) + ds
    direction = x + dx - eye
    shape = harmonics(direction / np.linalg.norm(direction))
    color = []
    for channel in range(3):
        own = [row[f"f_dc_{channel}"], *(row[f"f_rest_{channel * 15 + k}"] for k in range(15))]
        color.append(max(0.0, float(shape @ own) + 0.5))
    return Gaussian(x + dx, covariance(scales, q), float(sigmoid(row["opacity"])), np.array(color))


def spacetime_at(row: Mapping[str, float], t: float) -> Gaussian:
    """A row of SpacetimeGaussians' cloud at time t: channels are a colour, or those that the decoder gets."""
    d = t - row["trbf_center"]
    motion = np.array([row[f"motion_{i}"] for i in range(9)])
    mean = np.array([row[name] for name in "xyz"]) + motion[:3] * d + motion[3:6] * d**2 + motion[6:] * d**3
    q = np.array([row[f"rot_{i}"] + row[f"omega_{i}"] * d for i in range(4)])
    scales = np.exp([row[f"scale_{i}"] for i in range(3)])
    fading = math.exp(-((d / math.exp(row["trbf_scale"])) ** 2))
    if "f_t_0" in row:
        channels = [*(row[f"f_dc_{i}"] for i in range(6)), *(row[f"f_t_{i}"] * d for i in range(3))]
    else:
        channels = [row[f"f_dc_{i}"] for i in range(3)]
    opacity = float(sigmoid(row["opacity"])) * fading
    return Gaussian(mean, covariance(scales, q / np.linalg.norm(q)), opacity, np.array(channels))


def anchor_shows(row: Mapping[str, float], lens: Lens) -> bool:
    """Whether the published kernel finds the anchor itself on any tile of 16 x 16 pixels."""
    place, flat, depth = footprint(
        np.array([row[name] for name in "xyz"]), np.diag(np.exp([2 * row[f"scale_{i}"] for i in range(3)])), lens
    )
    middle = (flat[0, 0] + flat[1, 1]) / 2
    largest = middle + math.sqrt(max(0.1, middle**2 - np.linalg.det(flat)))
    radius = math.ceil(3 * math.sqrt(largest))
    count = 1
    for at, size in zip(place, (lens.width, lens.height)):
        tiles = (size + 15) // 16
        first = min(tiles, max(0, int((at - radius) / 16)))
        last = min(tiles, max(0, int((at + radius + 15) / 16)))
        count *= last - first
    return depth > 0.2 and count > 0


def anchor_at(
    row: Mapping[str, float],
    heads: Mapping[str, Mapping[str, np.ndarray]],
    t: float,
    eye: np.ndarray,
    ours: bool = True,
    flows: bool = True,
    beta: float = 4.0,
) -> list[Gaussian]:
    """The children that an anchor of 4D-Scaffold-GS has at time t, seen from `eye`."""

    def head(name: str, inputs: np.ndarray) -> np.ndarray:
        w = {key: array.astype(float) for key, array in heads[name].items()}
        return w["2.weight"] @ np.maximum(w["0.weight"] @ inputs + w["0.bias"], 0) + w["2.bias"]

    feature = np.array([row[f"f_anchor_feat_{i}"] for i in range(32)])
    place = np.array([row[name] for name in "xyz"])
    scale = np.exp([row[f"scale_{i}"] for i in range(8)])
    view = (place - eye) / np.linalg.norm(place - eye)
    rho, shape = np.tanh(head("opacity_mlp", feature)), head("cov_mlp", feature).reshape(-1, 8)
    flow = np.tanh(head("flow_mlp", feature)).reshape(-1, 3)
    color = sigmoid(head("color_mlp", np.concatenate([feature, view]))).reshape(-1, 3)
    children = len(rho)
    found = []
    for k in range(children):
        if rho[k] <= 0:
            continue
        offset = np.array([row[f"f_offset_{axis * children + k}"] for axis in range(4)])
        when = row["t"] + offset[3] * scale[3]
        mean = place + offset[:3] * scale[:3] + (flow[k] * (when - t) if flows else 0)
        raw = shape[k, 3]
        sigma = (raw if raw > 0 else math.exp(raw) - 1) + 1
        fading = math.exp(-(abs((when - t) * sigma) ** beta)) if ours else math.exp(-((when - t) ** 2) * sigma)
        q = shape[k, 4:] / np.linalg.norm(shape[k, 4:])
        cov = covariance(scale[4:7] * sigmoid(shape[k, :3]), q)
        found.append(Gaussian(mean, cov, float(rho[k] * fading), color[k]))
    return found


def sandwich(image: np.ndarray, lens: Lens, decoder: Mapping[str, np.ndarray], ends: bool) -> np.ndarray:
    """SpacetimeGaussians' decoder, pixel by pixel: [H, W, 9] to [H, W, 3]; `ends` in a sigmoid, or clamped."""
    first, second = (np.asarray(decoder[f"mlp{i}.weight"], float)[:, :, 0, 0] for i in (1, 2))
    out = np.empty((*image.shape[:2], 3))
    for row in range(lens.height):
        for column in range(lens.width):
            ray = np.array([(column + 0.5 - lens.cx) / lens.fx, (row + 0.5 - lens.cy) / lens.fy, 1.0])
            ray = lens.R.T @ (ray / np.linalg.norm(ray))
            albedo, rest = image[row, column, :3], image[row, column, 3:]
            inputs = np.concatenate([rest, -lens.R.T @ lens.t, ray])
            result = albedo + second @ np.maximum(first @ inputs, 0)
            out[row, column] = sigmoid(result) if ends else np.clip(result, 0, 1)
    return out
