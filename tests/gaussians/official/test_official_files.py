"""Files of official codes: hostile point clouds, weights and archives give one line and run nothing."""

from __future__ import annotations

import os
import pickle
import re
import warnings
import zipfile
from pathlib import Path

import numpy as np
import official_layouts as layouts
import pytest
import torch
from official_comparison import (
    rows_of,
)

from splashbench.errors import SplashbenchError
from splashbench.files.ply import read_point_cloud
from splashbench.gaussians.official.checkpoint import read_weights
from splashbench.gaussians.official.output_folder import TrainingArguments
from splashbench.scene import Scene
from splashbench_methods.deformable_3dgs.official import OfficialDeformable3DGS

POINTS = 20


def _cloud(out: Path) -> Path:
    return out / "point_cloud/iteration_20000/point_cloud.ply"


def _network(out: Path) -> Path:
    return out / "deform/iteration_20000/deform.pth"


class _Code:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.mark),)


def _edit(path: Path, change: object) -> None:
    path.write_bytes(change(path.read_bytes()))  # type: ignore[operator]


def _header(old: bytes, new: bytes) -> object:
    return lambda data: data.replace(old, new, 1)


_NAN = np.array([np.nan], "<f4").tobytes()
_BODY = b"end_header\n"

HOSTILE_CLOUDS = {
    "truncated": (lambda data: data[:-100], r"is cut short: 5 of 6 points are there"),
    "huge count": (_header(b"vertex 6", b"vertex 19999999"), r"is cut short: 6 of 19999999 points"),
    "endless count": (_header(b"vertex 6", b"vertex 99999999999"), r"has 99999999999 points, not 1 to 20000000"),
    "absurd count": (_header(b"vertex 6", b"vertex " + b"9" * 5000), r"begins with element vertex 99.*, not points"),
    "no points": (_header(b"vertex 6", b"vertex 0"), r"has 0 points, not 1 to 20000000"),
    "text": (_header(b"binary_little_endian", b"ascii"), r"is written as text; give the binary"),
    "list": (_header(b"float x", b"list uchar float x"), r"'property list uchar float x' in the header is not known"),
    "twice": (_header(b"float nx", b"float x"), r"has the property x twice"),
    "renamed": (_header(b"float scale_2", b"float scala_2"), r"lacks the property scale_2"),
    "rest": (_header(b"float f_rest_44", b"float other"), r"has 44 properties f_rest_, not 0, 9, 24 or 45"),
    "NaN": (lambda data: data.replace(_BODY, _BODY + _NAN, 1)[:-4], r"x has NaN or infinite entries"),
    "headless": (lambda data: data[20:], r"is no \.ply"),
    "endless": (lambda data: b"ply\n" + b"comment \n" * 10_000, r"is no \.ply"),
    "empty": (lambda data: b"", r"is no \.ply"),
}  # fmt: skip


class TestHostileFiles:
    @pytest.fixture
    def out(self, tmp_path: Path) -> Path:
        rng = np.random.default_rng(0)
        layouts.write_deformable(
            tmp_path / "out", rows_of(layouts.DEFORMABLE, rng), layouts.deform_network(rng, scale=0.0)
        )
        return tmp_path / "out"

    def refused(self, balls: Scene, nerfies: Path, out: Path) -> str:
        with pytest.raises(SplashbenchError) as stop:
            OfficialDeformable3DGS().read(out, nerfies, balls.training())
        return str(stop.value)

    @pytest.mark.parametrize("name", HOSTILE_CLOUDS)
    def test_a_cloud_gives_one_line(self, balls: Scene, nerfies: Path, out: Path, name: str) -> None:
        change, message = HOSTILE_CLOUDS[name]
        _edit(_cloud(out), change)
        said = self.refused(balls, nerfies, out)
        assert said.startswith(str(_cloud(out)))
        assert re.search(message, said)
        assert len(said) < 400

    def test_the_other_byte_order_and_doubles_are_read(self, tmp_path: Path) -> None:
        path = tmp_path / "a.ply"
        head = b"ply\r\nformat binary_big_endian 1.0\r\ncomment made by hand\r\nelement vertex 2\r\n"
        head += b"property double x\r\nproperty uchar y\r\nelement face 1\r\n"
        head += b"property list uchar int v\r\nend_header\r\n"
        body = np.array([(1.5, 7), (-2.0, 8)], [("x", ">f8"), ("y", "u1")]).tobytes()
        path.write_bytes(head + body + b"\x00")
        assert read_point_cloud(path).table("y", "x").tolist() == [[7, 1.5], [8, -2]]

    def test_numbers_that_overflow_are_told_of_at_once(self, balls: Scene, nerfies: Path, out: Path) -> None:
        rng = np.random.default_rng(0)
        layouts.write_ply(_cloud(out), layouts.DEFORMABLE, rows_of(layouts.DEFORMABLE, rng, scale_1=200.0))
        assert "factors of the Gaussians overflow at 0 s" in self.refused(balls, nerfies, out)

    def test_a_pickle_with_code_is_not_run(self, balls: Scene, nerfies: Path, out: Path, tmp_path: Path) -> None:
        mark = tmp_path / "ran"
        weights = _network(out)
        torch.save({"linear.0.weight": _Code(mark)}, weights)
        assert "deform.pth cannot be read as weights alone (UnpicklingError" in self.refused(balls, nerfies, out)
        weights.write_bytes(pickle.dumps(_Code(mark)))
        assert "deform.pth cannot be read as weights alone" in self.refused(balls, nerfies, out)
        assert not mark.exists()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"linear.3.weight": torch.zeros(256, 255)}, r"linear\.3\.weight is float32 \[256, 255\], not"),
            ({"linear.3.weight": torch.zeros(256, 256, dtype=torch.int64)}, r"linear\.3\.weight is int64 \[256, 256\]"),
            ({"gaussian_warp.bias": torch.tensor([0, np.nan, 0])}, r"gaussian_warp\.bias has NaN or infinite"),
            ({"extra": torch.zeros(1)}, r"has extra, which this network has not"),
            ({"linear.7.bias": None}, r"lacks linear\.7\.bias"),
        ],
    )  # fmt: skip
    def test_weights_that_do_not_fit_are_named(
        self, balls: Scene, nerfies: Path, out: Path, change: dict, message: str
    ) -> None:
        weights = torch.load(_network(out), weights_only=True) | change
        torch.save({name: tensor for name, tensor in weights.items() if tensor is not None}, _network(out))
        said = self.refused(balls, nerfies, out)
        assert said.startswith(str(_network(out)))
        assert re.search(message, said)

    def test_other_files_are_named(self, balls: Scene, nerfies: Path, out: Path) -> None:
        (out / "cfg_args").write_text("__import__('os').mkdir('ran')")
        assert "cfg_args does not begin with Namespace(" in self.refused(balls, nerfies, out)
        torch.save([torch.zeros(3)], _network(out))
        assert "deform.pth holds a list, not tensors by name" in self.refused(balls, nerfies, out)
        _network(out).write_bytes(b"PK\x03\x04 nonsense")
        assert "deform.pth cannot be read as weights alone" in self.refused(balls, nerfies, out)
        _network(out).unlink()
        assert "deform.pth does not exist; let the code save its last iteration" in self.refused(balls, nerfies, out)
        _cloud(out).unlink()
        (out / "point_cloud/iteration_7000/point_cloud.ply").unlink()
        assert "deform.pth does not exist" in self.refused(balls, nerfies, out)
        for folder in (out / "point_cloud").iterdir():
            folder.rmdir()
        assert "point_cloud holds no iteration_<n>" in self.refused(balls, nerfies, out)


def test_arguments_are_read_as_python_prints_them(tmp_path: Path) -> None:
    layouts.write_arguments(
        tmp_path, loader="it's, here='x'", white_background=True, duration=50, offsets=[1.0, 2.0], data_device="cuda"
    )
    arguments = TrainingArguments.read(tmp_path)
    assert arguments.text("source_path") == "/data, set/colmap_0"
    assert arguments.text("loader") == "it's, here='x'"
    assert arguments.number("duration") == 50
    assert arguments.flag("white_background")
    assert not arguments.flag("here")
    assert arguments.text("data_device") == "cuda"


class TestTracedModules:
    def traced(self, path: Path, network: torch.nn.Module, inputs: int) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.jit.save(torch.jit.trace(network.eval(), torch.rand(1, inputs)), path)

    def network(self) -> torch.nn.Sequential:
        return torch.nn.Sequential(
            torch.nn.Linear(32, 16), torch.nn.ReLU(True), torch.nn.Linear(16, 10), torch.nn.Tanh()
        )

    def test_weights_come_out_of_what_torch_traced(self, tmp_path: Path) -> None:
        network = self.network()
        self.traced(tmp_path / "a.pt", network, 32)
        found = read_weights(tmp_path / "a.pt")
        assert sorted(found) == ["0.bias", "0.weight", "2.bias", "2.weight"]
        for name, tensor in network.state_dict().items():
            assert torch.equal(found[name], tensor)

    def rewritten(self, source: Path, path: Path, name: str, data: bytes) -> None:
        with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
            for entry in old.namelist():
                new.writestr(entry, data if entry.endswith(name) else old.read(entry))

    def test_what_the_program_would_call_is_never_called(self, tmp_path: Path) -> None:
        self.traced(tmp_path / "a.pt", self.network(), 32)
        mark = tmp_path / "ran"
        for number, protocol in enumerate((2, 4)):
            hostile = pickle.dumps(_Code(mark), protocol=protocol)
            path = tmp_path / f"hostile{number}.pt"
            self.rewritten(tmp_path / "a.pt", path, "/data.pkl", hostile)
            with pytest.raises(SplashbenchError, match=r"hostile\d\.pt is TorchScript with more in it than weights"):
                read_weights(path)
        assert not mark.exists()

    @pytest.mark.parametrize(
        ("name", "data", "message"),
        [
            ("data/0", b"\0" * 40, "is damaged (ValueError: an array does not lie in its numbers)"),
            ("/data.pkl", b"\x80\x02.", "is damaged (IndexError"),
            ("/data.pkl", b"", "is damaged (ValueError"),
            ("/data.pkl", b"\x80\x02N.", "is damaged (AttributeError"),
            ("/data.pkl", b"\x80\x02" + b"r\xff\xff\xff\xff" * 3 + b".", "is damaged (IndexError"),
            ("/data.pkl", b"\x80\x02(ios\nmkdir\n.", "is TorchScript with more in it than weights (instruction INST)"),
        ],
    )
    def test_damaged_archives_give_one_line(self, tmp_path: Path, name: str, data: bytes, message: str) -> None:
        self.traced(tmp_path / "a.pt", self.network(), 32)
        self.rewritten(tmp_path / "a.pt", tmp_path / "b.pt", name, data)
        with pytest.raises(SplashbenchError) as stop:
            read_weights(tmp_path / "b.pt")
        assert message in str(stop.value)

    def test_archives_that_unpack_to_more_than_they_hold_are_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("splashbench.gaussians.official.checkpoint._MAX_BYTES", 1 << 20)
        with zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a/data.pkl", b"")
            archive.writestr("a/data/0", b"\0" * (2 << 20))
        assert (tmp_path / "a.pt").stat().st_size < 10_000
        with pytest.raises(SplashbenchError, match="holds more than 1 MiB"):
            read_weights(tmp_path / "a.pt")
