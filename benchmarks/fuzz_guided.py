"""Damaged files found by coverage: inputs that reach new lines of our readers are kept and changed further.

    pip install atheris
    python benchmarks/fuzz_guided.py png --minutes 10
    python benchmarks/fuzz_guided.py all --minutes 10              # of each kind, one after another

fuzz.py changes honest files at random. Here libFuzzer looks for what it misses: it sees which lines of the readers in
Python an input has reached, of splashbench and of the TOML parser, the mesh parser and zip archives. Reading must end
in a value or in a SplashbenchError of one printable line, within a minute and 6 GiB; exit status 1 tells of a finding,
whose input is kept (`--keep`, this folder by default).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import atheris

# What is imported before it is instrumented is not seen.
_INSTRUMENTED = ["splashbench.files", "splashbench.toml", "splashbench.scene", "splashbench.submission", "zipfile"]
with atheris.instrument_imports(include=_INSTRUMENTED):
    from fuzz_cases import Corpus, mutated, mutated_npz, mutated_png, mutated_text

    from splashbench import toml
    from splashbench.errors import SplashbenchError
    from splashbench.files import read_json, read_npz, read_png, require_png
    from splashbench.files.ply import read_point_cloud
    from splashbench.scene.layout import SceneMeta
    from splashbench.submission import Identity, Record

_MUTATORS = {"png": mutated_png, "npz": mutated_npz, "ply": mutated}
MAX_SECONDS, MAX_MEMORY_MIB, MAX_INPUT_BYTES = 60, 6144, 1 << 16


def readers() -> dict[str, tuple[str, Callable[[Path], Any]]]:
    """Kind -> (the file's name, what reads it)."""

    def checked(model: Any, data: Any) -> None:
        with contextlib.suppress(ValueError):
            model.model_validate(data).model_dump_json().encode()

    def png(path: Path) -> None:
        require_png(path, "RGB", pixels=True)
        read_png(path, "RGB")

    return {
        "toml": ("submission.toml", lambda path: checked(Identity, toml.load(path))),
        "record": ("record.json", lambda path: checked(Record, read_json(path))),
        "scene": ("scene.json", lambda path: checked(SceneMeta, read_json(path))),
        "npz": ("a.npz", lambda path: read_npz(path, {"positions": 3})),
        "png": ("a.png", png),
        "ply": ("a.ply", read_point_cloud),
    }


def fuzz(kind: str, minutes: float, keep: Path) -> None:
    """Look for findings in this process; ends it, with status 0 where there was none."""
    name, read = readers()[kind]
    folder = Path(tempfile.mkdtemp(prefix="splashbench-fuzz-"))
    seeds = folder / "seeds"
    seeds.mkdir()
    for number, content in enumerate(_honest(kind, folder)):
        (seeds / str(number)).write_bytes(content)
    path = folder / name

    def one(content: bytes) -> None:
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path)
        except SplashbenchError as error:
            if not str(error).isprintable():
                raise RuntimeError(f"not one line: {str(error)[:200]!r}") from error

    def mutate(content: bytes, max_bytes: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.5:  # checksums and headers hold, which libFuzzer's own changes break
            with contextlib.suppress(Exception):  # what is broken already has no structure to keep
                return _MUTATORS.get(kind, mutated_text)(rng, content)[:max_bytes]
        return atheris.Mutate(content, max_bytes)

    limits = [f"-max_total_time={minutes * 60:.0f}", f"-timeout={MAX_SECONDS}", f"-rss_limit_mb={MAX_MEMORY_MIB}"]
    atheris.Setup(
        [sys.argv[0], str(seeds), f"-max_len={MAX_INPUT_BYTES}", f"-artifact_prefix={keep}/{kind}-", *limits],
        one,
        custom_mutator=mutate,
    )
    atheris.Fuzz()


def _honest(kind: str, folder: Path) -> list[bytes]:
    """Honest files of `kind`."""
    (folder / "corpus").mkdir()
    corpus = Corpus(folder / "corpus")
    if kind == "ply":
        header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
        return [f"{header}property float x\nproperty float y\nproperty float z\nend_header\n".encode() + bytes(24)]
    files = {
        "toml": [corpus.submission_folder / "submission.toml"],
        "record": [corpus.submission_folder / "record.json"],
        "scene": [corpus.scene_folder / "scene.json"],
        "npz": [corpus.submission_folder / "particles.npz"],
        "png": sorted(corpus.submission_folder.rglob("*.png"))[:2],
    }[kind]
    return [path.read_bytes() for path in files]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = ("toml", "record", "scene", "npz", "png", "ply")
    parser.add_argument("kind", choices=(*kinds, "all"))
    parser.add_argument("--minutes", type=float, default=10.0, help="of each kind (default: 10)")
    parser.add_argument("--keep", type=Path, default=Path(), help="folder for inputs that are findings")
    arguments = parser.parse_args()
    if arguments.kind != "all":
        fuzz(arguments.kind, arguments.minutes, arguments.keep)
        return 0
    ended = {}
    for kind in kinds:
        command = [sys.executable, __file__, kind, "--minutes", str(arguments.minutes), "--keep", str(arguments.keep)]
        ended[kind] = subprocess.run(command, check=False).returncode
    print(json.dumps(ended))
    return int(any(ended.values()))


if __name__ == "__main__":
    sys.exit(main())
