"""A reader of fitted liquids that uses nothing of splashbench, written from storage/FORMAT.md alone."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import numpy as np


def read(directory: Path) -> dict[str, list[np.ndarray] | np.ndarray]:
    """Of every frame the carriers' numbers and places (voxels), phi (voxels), and the carriers' values [N, D]."""
    header = json.loads((directory / "liquid.json").read_text())
    rows, motion, distance, look = (
        np.load(directory / f"{name}.npz") for name in ("carriers", "motion", "distance", "appearance")
    )
    shape = np.array(header["grid"]["shape"])
    factor = np.broadcast_to(np.array(header["factor"], dtype=float), 3)
    births = np.repeat(np.arange(len(rows["births"])), rows["births"])
    count = len(births)
    lives = _table(rows["lives"], count, 1, 1)[:, 0]
    ends = births + lives
    cells = np.stack(np.unravel_index(np.cumsum(_table(rows["cells"], count, 1, 1)), shape), axis=1)
    steps = header["steps"]
    place = cells * steps + rows["within"]
    moves = iter(_table(rows["residuals"], lives.sum() - count, 3, 2))
    velocities = _field(motion["velocities"], (len(header["times"]) - 1, *motion["nodes"], 3))
    numbers, places = [], []
    for t in range(len(header["times"])):
        for number in np.flatnonzero((births < t) & (ends > t)):
            velocity = _velocity(velocities[t - 1], factor, place[number] / steps)
            led = place[number] + np.rint(velocity / 2).astype(int)
            place[number] = np.clip(led + next(moves), 0, shape * steps - 1)
        numbers.append(np.flatnonzero((births <= t) & (ends > t)))
        places.append(place[numbers[-1]] / steps)
    assert next(moves, None) is None
    phi = _frames(distance["phi"], (len(header["times"]), *shape), *distance["ends"].astype(int)) / 4 + 1 / 8
    size = len(look["center"])
    values, coarseness = np.zeros((count, size)), _table(look["coarseness"], count, 1, 1)[:, 0]
    for level in range(6):
        which = coarseness == level
        coefficients = _table(look[f"coefficients.{level}"], which.sum(), size, 0)
        values[which] = 2**level * (coefficients @ look["basis"].astype(float))
    return {"ids": numbers, "places": places, "phi": phi, "values": values + look["center"]}


def _velocity(control: np.ndarray, factor: np.ndarray, place: np.ndarray) -> np.ndarray:
    """In half a step a frame at `place` [3] (voxels), linear between control nodes."""
    nodes = np.array(control.shape[:3])
    at = np.clip((place - (factor - 1) / 2) / factor, 0, nodes - 1)
    low = np.minimum(at.astype(int), nodes - 2)
    share = at - low
    total = np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, share, 1 - share))
        total = total + weight * control[tuple(low + corner)]
    return total


class _Code:
    """Answers to questions, out of bytes."""

    def __init__(self, code: np.ndarray) -> None:
        self.bytes, self.range, self.zeros = iter(code.tolist()), 2**32 - 1, defaultdict(lambda: 2048)
        self.word = int.from_bytes(bytes(next(self.bytes) for _ in range(5)), "big")

    def _answer(self, bound: int) -> int:
        """1 where the word is not below `bound`, which is not its part of the range then."""
        answer = int(self.word >= bound)
        self.word, self.range = (self.word - bound, self.range - bound) if answer else (self.word, bound)
        while self.range < 2**24:
            self.word, self.range = (self.word << 8) | next(self.bytes), self.range << 8
        return answer

    def ask(self, *question: object) -> int:
        zero = self.zeros[question]
        answer = self._answer((self.range >> 12) * zero)
        self.zeros[question] += -(zero >> 5) if answer else (4096 - zero) >> 5
        return answer

    def ask_evenly(self) -> int:
        half = self.range >> 1
        self.range = 2 * half
        return self._answer(half)

    def number(self, *context: object) -> int:
        if not self.ask(*context, "other than zero"):
            return 0
        sign = -1 if self.ask(*context, "below") else 1
        digits = 0
        while digits < 31 and self.ask(*context, "longer", digits):
            digits += 1
        size = 1
        for digit in range(digits):
            size = 2 * size + (self.ask_evenly() if digit else self.ask(*context, "second", digits))
        return sign * size

    def end(self) -> None:
        assert next(self.bytes, None) is None


def _size(total: int) -> int:
    return min(int(total).bit_length(), 9)


def _table(code: np.ndarray, rows: int, columns: int, near: int) -> np.ndarray:
    table, asked = np.zeros((rows + 2, columns + 2), int), _Code(code)  # with two rows and columns of zeros before
    for row in range(2, rows + 2):
        for column in range(2, columns + 2):
            before = 2 * abs(table[row - 1, column]) + abs(table[row - 2, column]) if near else 0
            beside = 2 * abs(table[row, column - 1]) + abs(table[row, column - 2]) if near == 2 else 0
            table[row, column] = asked.number(column, _size(before), _size(beside))
    asked.end()
    return table[2:, 2:]


def _field(code: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    field, asked = np.zeros(shape, int), _Code(code)
    for t, x, y, z, component in np.ndindex(*shape):
        b = field[t, x, y - 1, z, component] if y else None
        a = field[t, x - 1, y, z, component] if x else (b if y else 0)
        b = b if y else a
        c = field[t, x, y, z - 1, component] if z else b
        before = field[t, x, y, z, component - 1] if component else None
        if [a, b, c].count(0) >= 2:
            likely, kind = 0, 9 if component and before == 0 else 8
        else:
            likely = field[t - 1, x, y, z, component] if t else 0
            kind = min(1 + _size(abs(before)), 8) if component else 0
        differ = _size((abs(a - b) + abs(b - c) + abs(a - c)) // 4)
        field[t, x, y, z, component] = likely + asked.number(component, differ, kind)
    asked.end()
    return field


def _frames(code: np.ndarray, shape: tuple[int, ...], least: int, most: int) -> np.ndarray:
    asked, frames = _Code(code), np.zeros((shape[0] + 1, *(n + 1 for n in shape[1:])), int)  # zeros before, at index 0
    blocks = tuple(-(-n // 4) for n in shape[1:])
    before = np.zeros(blocks, int)
    for now, had in zip(frames[1:], frames):
        changes = np.zeros([n + 1 for n in blocks], int)
        now[:] = had
        for i, j, k in np.ndindex(*blocks):
            nearby = changes[i, j + 1, k + 1], changes[i + 1, j, k + 1], changes[i + 1, j + 1, k]
            changes[i + 1, j + 1, k + 1] = asked.ask("block", before[i, j, k], *nearby)
            if not changes[i + 1, j + 1, k + 1]:
                continue
            corner = np.array([4 * i, 4 * j, 4 * k])
            for at in np.ndindex(*np.minimum(4, shape[1:] - corner)):
                x, y, z = corner + at + 1
                gains = [int(now[n] - had[n]) for n in ((x - 1, y, z), (x, y - 1, z), (x, y, z - 1))]
                gained, differ = sum(gains), 2 * (max(gains) - min(gains))
                likely = min(max(had[x, y, z] + (2 * gained + 3) // 6, least), most)
                ends = [2 if value <= least else int(value >= most) for value in (likely, had[x, y, z])]
                kind = sum(differ > bound for bound in (0, 2, 4, 8, 14, 24))
                much = int(gained != 0) + int(abs(gained) > 3)
                now[x, y, z] = likely + asked.number("node", kind, *ends, much)
        before = changes[1:, 1:, 1:]
    asked.end()
    return frames[1:, 1:, 1:, 1:]
