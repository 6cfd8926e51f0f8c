"""Files that nobody meant: mutations of honest ones, by kind, and what may come of reading them.

A case is a kind and a number, from which everything follows, so that a finding can be made again. Reading it must end
in a value or in a SplashbenchError of one printable line. Besides, what `check` passes, `score` must take.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import random
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_media import honest_media, mutated_media

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import image_size, read_gray, read_image, read_json, read_npz, require_png
from splashbench.files.png import png_of
from splashbench.scene import Particles, Scene, SignedDistance
from splashbench.scene.layout import SceneMeta
from splashbench.score import Result
from splashbench.submission import Identity, Record, seal, to_8bit, write_view

_TEXTS = (
    *("0", "-1", "1e308", "-1e308", "1e400", "NaN", "Infinity", "nan", "inf", "null", "true", '""', "[]", "{}"),
    *("9" * 400, "9" * 5000, '"\\ud800"', '"\\u0000"', '"\x7f"', "1979-05-27T07:32:00Z", "0x7fffffffffffffff"),
    *("[" * 50 + "]" * 50, "[" * 2000, '{"a":' * 40 + "1" + "}" * 40, "a." * 100 + "b = 1\n", "\u2028", "\ufeff", "\\"),
    *(
        '"../../etc/passwd"',
        '"/dev/zero"',
        '"a\\nb"',
        "1e-320",
        "4294967296",
        "18446744073709551616",
        "0.1.2",
        "'''",
        "#",
    ),
)
_NUMBERS = (0, 1, 2, 3, 7, 8, 16, 127, 128, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1)


def mutated(rng: random.Random, content: bytes) -> bytes:
    """`content` with a few bytes changed, cut, doubled, moved or put in."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        place = rng.randrange(len(data) + 1)
        length = rng.choice((1, 2, 4, 16, 200))
        what = rng.randrange(8)
        if what == 0 and place < len(data):
            data[place] ^= 1 << rng.randrange(8)
        elif what == 1:
            data[place : place + length] = rng.randbytes(length)
        elif what == 2:
            del data[place : place + length]
        elif what == 3:
            del data[place:]
        elif what == 4:
            data[place:place] = data[place : place + length] * rng.choice((1, 2, 50))
        elif what == 5:
            data[place : place + 4] = struct.pack(rng.choice("<>") + "I", rng.choice(_NUMBERS))
        elif what == 6:
            data[place:place] = rng.choice(_TEXTS).encode("utf-8", "surrogatepass")
        else:
            other = rng.randrange(len(data) + 1)
            data[place : place + length] = data[other : other + length]
    return bytes(data)


def mutated_text(rng: random.Random, content: bytes) -> bytes:
    """The text `content` with tokens or lines replaced, doubled, moved or left out; or mutated as bytes."""
    if rng.random() < 0.25:
        return mutated(rng, content)
    text = content.decode("utf-8", "replace")
    for _ in range(rng.choice((1, 1, 2, 5))):
        what = rng.randrange(4)
        tokens = re.split(r"(\s+|[,:=\[\]{}])", text)
        if what < 2:
            tokens[rng.randrange(len(tokens))] = rng.choice(_TEXTS)
            text = "".join(tokens)
        else:
            lines = text.split("\n")
            line = lines.pop(rng.randrange(len(lines)))
            for _ in range(rng.choice((0, 2, 30))):
                lines.insert(rng.randrange(len(lines) + 1), line)
            text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass")


def mutated_npz(rng: random.Random, content: bytes) -> bytes:
    """An archive with other headers, contents, names and compressions; or mutated as bytes."""
    if rng.random() < 0.4:
        return mutated(rng, content)
    try:
        return _other_archive(rng, content)
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, zlib.error, NotImplementedError):
        return mutated(rng, content)  # it was mutated already


def _other_archive(rng: random.Random, content: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            what = rng.randrange(6)
            if what == 0:
                data = mutated(rng, data)
            elif what == 1:
                kind = rng.choice(("<f4", "<f8", ">i2", "|b1", "|O", "<U5", "<c16", "<M8[s]", "|V9", "<f2", "garbage"))
                shape = [rng.choice((*_NUMBERS, -1, -5, 10**12)) for _ in range(rng.randrange(5))]
                header = (
                    f"{{'descr': '{kind}', 'fortran_order': {rng.choice((True, False))}, 'shape': {tuple(shape)}}}\n"
                )
                data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data[128:]
            elif what == 2:
                name = rng.choice((name.removesuffix(".npy"), "../" + name, name + "\0", "a" * 300))
            elif what == 3:
                data += bytes(rng.choice((1, 1000, 3_000_000)))
            compression = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                target.writestr(zipfile.ZipInfo(name), data, compress_type=compression)
    return out.getvalue()


def mutated_png(rng: random.Random, content: bytes) -> bytes:
    """A PNG with other chunks, whose checksums hold; or mutated as bytes."""
    if rng.random() < 0.4 or not content.startswith(b"\x89PNG"):
        return mutated(rng, content)
    chunks, place = [], 8
    while place + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, place)
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + length]))
        place += 12 + length
    for _ in range(rng.choice((1, 1, 3))):
        k = rng.randrange(len(chunks))
        kind, data = chunks[k]
        what = rng.randrange(5)
        if what == 0:
            chunks[k] = kind, mutated(rng, data)
        elif what == 1:
            chunks.insert(
                k, (rng.choice((b"zTXt", b"iCCP", b"acTL", b"fdAT", b"eXIf", b"tRNS", b"PLTE", b"gAMA")), data)
            )
        elif what == 2 and len(chunks) > 1:
            del chunks[k]
        elif what == 3:
            stated = [*struct.unpack(">IIBBBBB", chunks[0][1].ljust(13, b"\0")[:13])]
            place = rng.randrange(7)
            stated[place] = rng.choice(_NUMBERS if place < 2 else (0, 1, 2, 3, 4, 6, 8, 16))
            chunks[0] = b"IHDR", struct.pack(">IIBBBBB", *stated)
        else:
            chunks[k] = kind, data + zlib.compress(bytes(100_000))
    return png_of(chunks)


def mutated_glb(rng: random.Random, content: bytes) -> bytes:
    """A GLB whose JSON part is mutated and framed anew; or mutated as bytes."""
    if rng.random() < 0.3:
        return mutated(rng, content)
    (length,) = struct.unpack_from("<I", content, 12)
    part = mutated_text(rng, content[20 : 20 + length].rstrip())
    part += b" " * (-len(part) % 4)
    rest = content[20 + length :]
    return (
        struct.pack("<4sII", b"glTF", 2, 20 + len(part) + len(rest))
        + struct.pack("<I4s", len(part), b"JSON")
        + part
        + rest
    )


class Corpus:
    """Honest files, made once in `folder`: a scene of three cameras and two frames, and a submission of it."""

    def __init__(self, folder: Path) -> None:
        from splashbench.synth.balls import write_balls_scene

        self.folder = folder
        self.scene_folder, self.submission_folder = folder / "scene", folder / "submission"
        self.scene = write_balls_scene(self.scene_folder, (20, 14), 2)
        rng = np.random.default_rng(0)
        for name in self.scene.test:
            for t in range(self.scene.n_frames):
                write_view(
                    self.submission_folder, name, t, to_8bit(rng.random((14, 20, 3))), to_8bit(rng.random((14, 20)))
                )
        Particles(rng.random((2, 70, 3)) * 0.3, np.ones((2, 70), bool)).save(self.submission_folder / "particles.npz")
        geometry = SignedDistance.of(rng.normal(size=(2, 6, 5, 4)), np.zeros(3), 0.1)
        geometry.save(self.submission_folder / "geometry.npz")
        settings = {"a": 1, "b": {"c": [0.5, "text"], "d": True}}
        identity = Identity(method="fuzz", scene=self.scene.name, scene_digest=self.scene.digest, settings=settings)
        record = Record(
            fit_seconds=1.5, stages={"one": 0.5}, notes={"what": "this"}, storage_bytes=100, timed_frames=100
        )
        seal(self.submission_folder, identity, record)
        self.meshes = _meshes()
        (folder / "media").mkdir()
        self.media = honest_media(folder / "media")

    def fresh(self, name: str) -> Path:
        """A copy of the folder "scene" or "submission", to be damaged."""
        target = self.folder / f"{name}_case"
        shutil.rmtree(target, ignore_errors=True)
        return Path(shutil.copytree(self.folder / name, target))


def _meshes() -> dict[str, bytes]:
    import trimesh

    box = trimesh.creation.box()
    scene = trimesh.Scene()
    for x in range(2):
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([x, 0, 0]))
    return {
        "a.ply": trimesh.exchange.ply.export_ply(box, encoding="ascii"),
        "b.ply": trimesh.exchange.ply.export_ply(box),
        "c.obj": trimesh.exchange.obj.export_obj(box).encode(),
        "d.glb": scene.export(file_type="glb"),
    }


def outcome(kind: str, number: int, corpus: Corpus) -> str:
    """What is wrong with how case `number` of `kind` is read; empty where nothing is."""
    rng = random.Random(f"{kind} {number}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return CASES[kind](rng, corpus)
    except SplashbenchError as error:
        return "" if str(error).isprintable() else f"not one line: {str(error)[:200]!r}"


def _file(corpus: Corpus, name: str, content: bytes) -> Path:
    path = corpus.folder / name
    path.write_bytes(content)
    return path


def _toml(rng: random.Random, corpus: Corpus) -> str:
    content = (corpus.submission_folder / "submission.toml").read_bytes()
    data = toml.load(_file(corpus, "case.toml", mutated_text(rng, content)))
    with contextlib.suppress(ValueError):
        Identity.model_validate(data).model_dump_json().encode()
    return ""


def _json(rng: random.Random, corpus: Corpus) -> str:
    name, model = rng.choice((("submission/record.json", Record), ("scene/scene.json", SceneMeta)))
    data = read_json(_file(corpus, "case.json", mutated_text(rng, (corpus.folder / name).read_bytes())))
    with contextlib.suppress(ValueError):
        model.model_validate(data).model_dump_json().encode()
    return ""


def _npz(rng: random.Random, corpus: Corpus) -> str:
    name = rng.choice(("particles.npz", "geometry.npz", "init_pt_cld.npz"))
    of = corpus.scene_folder if name.startswith("init") else corpus.submission_folder
    path = _file(corpus, "case.npz", mutated_npz(rng, (of / name).read_bytes()))
    if name.startswith("init"):
        read_npz(path, {"data": 2})
    else:
        {"particles.npz": Particles.load, "geometry.npz": SignedDistance.load}[name](path)
    return ""


def _image(rng: random.Random, corpus: Corpus) -> str:
    from PIL import Image

    pixels = Image.fromarray(np.random.default_rng(rng.randrange(5)).integers(0, 255, (9, 13, 3), dtype=np.uint8))
    stream = io.BytesIO()
    mode = rng.choice(("RGB", "L", "P", "RGBA", "LA", "1", "I;16"))
    if rng.random() < 0.3:
        pixels.save(stream, "JPEG", progressive=rng.random() < 0.5)
    else:
        (pixels.convert("I").convert(mode) if mode == "I;16" else pixels.convert(mode)).save(stream, "PNG")
    path = _file(corpus, "case.png", mutated_png(rng, stream.getvalue()))
    read = rng.choice((image_size, read_image, read_gray, lambda path: require_png(path, "RGB", pixels=True)))
    read(path)
    return ""


def _mesh(rng: random.Random, corpus: Corpus) -> str:
    from splashbench.scene.container import ContainerMesh
    from splashbench.scene.mesh_process import decoded

    name = rng.choice(list(corpus.meshes))
    content = corpus.meshes[name]
    mutate = mutated_glb if name.endswith("glb") else mutated if name == "b.ply" else mutated_text
    path = _file(corpus, name, mutate(rng, content))
    # What trimesh raises is caught in its process; here the limits are this process's.
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            vertices, faces = decoded(path, 2_000_000)
    except Exception:
        return ""
    with contextlib.suppress(ValueError):
        ContainerMesh(vertices, faces)
    return ""


def _media(rng: random.Random, corpus: Corpus) -> str:
    from splashbench.prepare.audio.waveform import join_audio
    from splashbench.prepare.video.recording import Recording

    name = rng.choice(list(corpus.media))
    path = _file(corpus, name, mutated_media(rng, name, corpus.media[name], mutated))
    recording = Recording([path])
    for read in (
        lambda: recording.headers[0],
        lambda: recording.info,
        lambda: list(recording.frames(range(0, recording.info.n_frames, 3))),
        lambda: list(recording.luma(16, keyframes=True)),
        lambda: join_audio([path], [0.0], 16000),
    ):
        try:
            read()
        except SplashbenchError as error:
            if not str(error).isprintable():
                return f"not one line: {str(error)[:200]!r}"
    return ""


def _command(*words: object) -> tuple[int, str]:
    from splashbench.cli.main import main

    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        status = main([str(word) for word in words])
    return status, errors.getvalue()


def _damaged(rng: random.Random, folder: Path) -> None:
    """Change a file or two of `folder`, each by the way of its kind, or put something else in its place."""
    for _ in range(rng.choice((1, 1, 2))):
        found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        files = sorted(path for path in found if path.name != "SHA256SUMS" and path.stat().st_size < 1 << 30)
        path = rng.choice(files)
        if rng.random() < 0.5:  # small files are few, and images many
            path = rng.choice([file for file in files if file.suffix in (".json", ".toml", ".npz")] or files)
        if rng.random() < 0.85:
            mutate: Callable[[random.Random, bytes], bytes] = {".png": mutated_png, ".npz": mutated_npz}.get(
                path.suffix, mutated_text
            )
            path.write_bytes(mutate(rng, path.read_bytes()))
            continue
        what = rng.randrange(6)
        if what != 5:
            path.unlink()
        if what == 0:
            os.mkfifo(path)
        elif what == 1:
            path.mkdir()
        elif what == 2:
            path.symlink_to(rng.choice(("/dev/zero", "/proc/kmsg", "/proc/self/mem", path.name, "nowhere")))
        elif what == 3:
            with path.open("wb") as stream:
                stream.truncate(1 << 40)
        elif what == 4:
            path.write_bytes(b"")
        else:
            odd = rng.choice((b"a\xff", b"a\nb", b"a b", b".hidden", "\u2028".encode(), b"d/e/f"))
            place = Path(os.fsdecode(os.fsencode(path.parent) + b"/" + odd))
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(b"more")


def _resealed(folder: Path) -> None:
    lines = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink() and path.name != "SHA256SUMS" and path.stat().st_size < 1 << 30:
            lines.append(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(folder).as_posix()}\n")
    (folder / "SHA256SUMS").write_bytes("".join(lines).encode("utf-8", "surrogateescape"))


def _submission(rng: random.Random, corpus: Corpus) -> str:
    folder = corpus.fresh("submission")
    _damaged(rng, folder)
    if rng.random() < 0.85:
        _resealed(folder)
    elif rng.random() < 0.5:
        sums = folder / "SHA256SUMS"
        sums.write_bytes(mutated(rng, sums.read_bytes()))
    status, said = _command("check", folder, "--scene", corpus.scene_folder, "--pixels")
    if status == 1 and "error: " not in said:
        return f"check gave {status} and said {said[:200]!r}"
    if rng.random() < 0.5:
        results = corpus.folder / "results"
        shutil.rmtree(results, ignore_errors=True)
        scored, told = _command("score", folder, "--scene", corpus.scene_folder, "--out", results)
        if status == 0 and scored != 0:
            return f"check passed what score refused: {told[-300:]!r}"
        for path in results.glob("*.json"):
            Result.load(path)  # what was scored is read again
    return ""


def _scene(rng: random.Random, corpus: Corpus) -> str:
    folder = corpus.fresh("scene")
    _damaged(rng, folder)
    status, said = _command("scene", "check", folder)
    if status == 1 and "error: " not in said:
        return f"scene check gave {status} and said {said[:200]!r}"
    if status == 0:
        with contextlib.suppress(SplashbenchError):
            Scene.open(folder).digest  # noqa: B018
    return ""


#: Kind -> what reads a case of it, and says what is wrong with how that went.
CASES: dict[str, Callable[[random.Random, Corpus], str]] = {
    "toml": _toml,
    "json": _json,
    "npz": _npz,
    "image": _image,
    "mesh": _mesh,
    "media": _media,
    "submission": _submission,
    "scene": _scene,
}
