"""A submission on disk: what a method hands in, written completely, read only when its digests are right.

submission.toml             identity
record.json                 status and costs, by the harness
renders/<cam>/<frame>.png   sRGB, test views       (status ok only)
alpha/<cam>/<frame>.png     foreground opacity     (status ok only)
particles.npz               positions [T, N, 3], active [T, N]; optional
geometry.npz                the liquid's signed distance [T, nx, ny, nz]; optional
checkpoints/<k>/            renders and alpha of the fit on its way; optional
SHA256SUMS                  of every other file
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import (
    Listing,
    is_plain_file,
    list_files,
    read_model,
    read_plain,
    read_png,
    require_png,
    sha256_file,
    validate_model,
    write_model,
    write_png,
    write_text,
)
from splashbench.scene import Camera, Particles, Scene, SignedDistance
from splashbench.submission.identity import Checkpoint, Identity, Record, Status

IDENTITY = "submission.toml"
SUMS = "SHA256SUMS"
#: Of a submission's files together, and of their list of sums.
MAX_BYTES, _MAX_SUMS_BYTES = 16 << 30, 64 << 20
_SUM = re.compile(r"[0-9a-f]{64}")
#: Folder of a test view's images -> their colour. Others would be scored as something that they do not show.
_COLOURS = {"renders": "RGB", "alpha": "grey"}


def render_path(directory: Path, kind: str, camera: str, t: int) -> Path:
    """The file of `kind` ("renders" or "alpha") for `camera` at timestep `t`."""
    return Path(directory) / kind / camera / f"{t:06d}.png"


def to_8bit(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Round values in [0, 1] to 8 bits, clipping what lies outside."""
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def write_view(directory: Path, camera: str, t: int, rgb: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> None:
    """Write one test view: rgb uint8 [H, W, 3] and foreground opacity uint8 [H, W]."""
    write_png(render_path(directory, "renders", camera, t), rgb)
    write_png(render_path(directory, "alpha", camera, t), alpha)


def seal(directory: Path, identity: Identity, record: Record) -> None:
    """Write identity, record and, last, the digests of everything in `directory`.

    Raises SplashbenchError for a file in it that no submission may have, see `unusable_files`.
    """
    directory = Path(directory)
    faults = unusable_files(directory)
    if faults:
        raise SplashbenchError(f"{faults[0]}; a submission holds plain files alone")
    write_text(directory / IDENTITY, identity_text(identity))
    write_model(directory / "record.json", record)
    names = (name for name in list_files(directory).names if name != SUMS)
    write_text(directory / SUMS, "".join(f"{sha256_file(directory / name)}  {name}\n" for name in names))


def unusable_files(directory: Path) -> list[str]:
    """A line for every link, pipe, device and unusable name below `directory`, and for more files or bytes than a
    submission may have; nothing is opened."""
    return _listing(directory).faults


def _listing(directory: Path) -> Listing:
    try:
        listing = list_files(directory)
    except SplashbenchError as error:
        return Listing(faults=[str(error)])
    if listing.bytes > MAX_BYTES:
        listing.faults.append(f"{directory} has more than {MAX_BYTES >> 30} GiB; this is no submission")
    return listing


def identity_text(identity: Identity) -> str:
    """submission.toml of `identity`. Raises TypeError where its settings hold what TOML cannot say."""
    return toml.dumps(identity.model_dump(mode="json", exclude_none=True))


class Views:
    """The test views in a folder: of a submission, or of a state of its fit on its way. identity: of the submission."""

    def __init__(self, directory: Path, identity: Identity) -> None:
        self.directory, self.identity = Path(directory), identity

    def rendering(self, camera: str, t: int) -> NDArray[np.uint8]:
        """Rendered sRGB uint8 [H, W, 3] of test view `camera` at timestep `t`."""
        return read_png(render_path(self.directory, "renders", camera, t), _COLOURS["renders"])

    def alpha(self, camera: str, t: int) -> NDArray[np.float32]:
        """Rendered foreground opacity [H, W] in [0, 1] of test view `camera` at timestep `t`."""
        path = render_path(self.directory, "alpha", camera, t)
        return read_png(path, _COLOURS["alpha"]).astype(np.float32) / 255.0


class Submission(Views):
    """A verified submission. Use `Submission.open`.

    Attributes: directory; identity (method, preset, seed, scene ...); record (costs); status; reason.
    """

    def __init__(self, directory: Path, identity: Identity, record: Record) -> None:
        super().__init__(directory, identity)
        self.record = record
        self.status, self.reason = record.status, record.reason

    def __repr__(self) -> str:
        identity, record = self.identity, self.record
        costs = [] if record.fit_seconds is None else [f"fit {record.fit_seconds:.0f} s"]
        costs += [] if record.storage_bytes is None else [f"{record.storage_bytes / 1e6:.1f} MB"]
        run = f"{identity.method} ({identity.preset}, seed {identity.seed}) of {identity.scene}"
        return f"<Submission {run}: {', '.join([self.status.value, *costs])}>"

    @classmethod
    def open(cls, directory: Path, verify: bool = True) -> Submission:
        """Read the submission in `directory`; with `verify`, refuse it when a file was changed, added or removed."""
        directory = Path(directory)
        if not is_plain_file(directory / IDENTITY):
            raise SplashbenchError(f"{directory} is no submission (no {IDENTITY} in it); give a run's folder")
        if verify:
            faults = integrity_faults(directory)
            if faults:
                more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
                raise SplashbenchError(f"{faults[0]}{more}; the submission is refused: run the method again")
        path = directory / IDENTITY
        identity = validate_model(path, Identity, toml.load(path))
        return cls(directory, identity, read_model(directory / "record.json", Record))

    @property
    def digest(self) -> str:
        """SHA-256 of SHA256SUMS: names this submission's exact bytes."""
        return sha256_file(self.directory / SUMS)

    def checkpoints(self) -> list[tuple[Checkpoint, Views]]:
        """The states of the fit on its way, with their views; of those that have some (status ok)."""
        return [
            (checkpoint, Views(self.directory / checkpoint.folder, self.identity))
            for checkpoint in self.record.checkpoints
            if checkpoint.status == Status.OK
        ]

    def particles(self) -> Particles | None:
        """The method's particles, or None."""
        path = self.directory / "particles.npz"
        return Particles.load(path) if path.is_file() else None

    def geometry(self) -> SignedDistance | None:
        """The liquid's signed distance, or None."""
        path = self.directory / "geometry.npz"
        return SignedDistance.load(path) if path.is_file() else None


def integrity_faults(directory: Path) -> list[str]:
    """A line for every file that was changed, is missing, was added, or is no plain file."""
    directory = Path(directory)
    path = directory / SUMS
    if not path.is_file():
        return [f"{path} is missing"]
    listing = _listing(directory)
    if listing.faults:
        return listing.faults
    try:
        text = read_plain(path, _MAX_SUMS_BYTES).decode("utf-8")
    except SplashbenchError as error:
        return [str(error)]
    except (OSError, UnicodeDecodeError) as error:
        return [f"{path} cannot be read ({error})"]
    listed: dict[str, str] = {}
    for line in text.removesuffix("\n").split("\n") if text else ():
        digest, separator, name = line.removesuffix("\r").partition("  ")
        if not separator or not _SUM.fullmatch(digest):
            return [f"{path}: {line[:60]!r} is not a digest and a file name"]
        if name in listed:
            return [f"{path} lists {name[:200]!r} twice"]
        listed[name] = digest
    present = set(listing.names) - {SUMS}
    faults = [f"{directory / name} is missing" for name in sorted(set(listed) - present)]
    faults += [f"{directory / name} is not listed in {SUMS}" for name in sorted(present - set(listed))]
    sums = (_sum_fault(directory / name, listed[name]) for name in sorted(present & set(listed)))
    return faults + [fault for fault in sums if fault]


def _sum_fault(path: Path, digest: str) -> str:
    try:
        return "" if sha256_file(path) == digest else f"{path} does not match its digest in {SUMS}"
    except (SplashbenchError, OSError) as error:
        return f"{path} cannot be read ({error})"


def check_submission(directory: Path, scene: Scene | None = None, pixels: bool = False) -> list[str]:
    """Every fault of a submission at once, a line each: bytes, identity, and against `scene` sizes and frames.

    pixels: whether to unpack every view as well, see `require_png`.
    """
    directory = Path(directory)
    try:
        submission = Submission.open(directory, verify=False)
    except SplashbenchError as error:
        return [str(error)]
    faults = integrity_faults(directory)
    instants: dict[str, int] = {}
    for name, read in (("particles.npz", submission.particles), ("geometry.npz", submission.geometry)):
        try:
            arrays = read()
        except SplashbenchError as error:
            faults.append(str(error))
            continue
        if arrays is not None:
            instants[name] = arrays.n_frames
    if scene is None or submission.status != Status.OK:
        return faults
    if submission.identity.scene_digest != scene.digest:
        faults.append(f"{directory} was made for another version of scene {submission.identity.scene}")
    for name, n_frames in instants.items():
        if n_frames != scene.n_frames:
            faults.append(f"{directory / name} has {n_frames} instants, the scene {scene.n_frames}")
    faults += _view_faults(directory, scene, pixels)
    for _, views in submission.checkpoints():
        faults += _view_faults(views.directory, scene, pixels)
    return faults


def _view_faults(directory: Path, scene: Scene, pixels: bool) -> list[str]:
    """A line for every view below `directory` that scoring would refuse: see `require_png`, and of another size."""
    views = [
        (scene.cameras[name], kind, t)
        for name in scene.test
        for t in range(scene.n_frames)
        for kind in ("renders", "alpha")
    ]

    def fault(view: tuple[Camera, str, int]) -> str:
        return _view_fault(directory, *view, pixels)

    if not pixels:
        return [line for line in map(fault, views) if line]
    from splashbench.parallel import each

    return [line for line in each(fault, views) if line]  # unpacking releases the GIL


def _view_fault(directory: Path, camera: Camera, kind: str, t: int, pixels: bool) -> str:
    path = render_path(directory, kind, camera.name, t)
    try:
        header = require_png(path, _COLOURS[kind], pixels)
    except SplashbenchError as error:
        return str(error)
    if (header.width, header.height) != (camera.width, camera.height):
        return f"{path} is {header.width}x{header.height}, not {camera.width}x{camera.height}"
    return ""
