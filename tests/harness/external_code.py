"""An external code, as tests run it by commands: `fit` and `render`, well-behaved and otherwise."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

SLEEP = [sys.executable, "-c", "import time; time.sleep(300)"]


def leave_processes(note: Path) -> None:
    """One in the process group, one that left it; `note` gets their ids."""
    ids = [subprocess.Popen(SLEEP).pid, subprocess.Popen(SLEEP, start_new_session=True).pid]
    (note.parent / "ids.part").write_text(" ".join(map(str, [os.getpid(), *ids])))
    (note.parent / "ids.part").rename(note)


def fit(behaviour: str, scene: str, out: str, *rest: str) -> None:
    print("fitting", behaviour)
    if behaviour == "crash":
        raise SystemExit("the matrix is singular")
    if behaviour == "out_of_memory":
        raise SystemExit("RuntimeError: CUDA out of memory. Tried to allocate 20.00 GiB")
    if behaviour == "killed":
        os.kill(os.getpid(), 9)
    if behaviour in ("hang", "left_behind"):
        leave_processes(Path(rest[0]))
    if behaviour == "hang":
        time.sleep(300)
    if behaviour == "large":
        subprocess.run([sys.executable, "-c", "x = b'1' * 300_000_000; import time; time.sleep(0.6)"], check=True)
    import numpy as np
    from PIL import Image

    content = json.loads(Path(scene, "transforms_train.json").read_text())
    test = json.loads(Path(scene, "transforms_test.json").read_text())
    assert not any(Path(scene, frame["file_path"] + ".png").exists() for frame in test["frames"])
    pictures = [np.asarray(Image.open(Path(scene, frame["file_path"] + ".png"))) for frame in content["frames"]]
    colour = np.mean([picture.mean(axis=(0, 1)) for picture in pictures], axis=0)
    Path(out, "static").mkdir()
    Path(out, "static", "background.bin").write_bytes(b"0" * 1000)
    Path(out, "model.json").write_text(json.dumps({"colour": colour.tolist(), "arguments": rest}))
    Path(out, "latest").symlink_to(Path(out, "model.json"))


def render(behaviour: str, out: str, views: str, into: str) -> None:
    if behaviour == "crash":
        raise SystemExit("no such layer")
    import numpy as np
    from PIL import Image

    colour = np.round(json.loads(Path(out, "model.json").read_text())["colour"])
    listed = json.loads(Path(views).read_text())
    for number, view in enumerate(listed["views"]):
        camera = listed["cameras"][view["camera"]]
        size = (camera["height"], camera["width"])
        if behaviour == "wrong_size" and number == 5:
            size = (size[0] // 2, size[1] // 2)
        if behaviour == "missing" and number in (3, 4):
            continue
        for name in ("render", "alpha"):
            Path(into, view[name]).parent.mkdir(parents=True, exist_ok=True)
        rgb = np.broadcast_to(colour, (*size, 3)).astype(np.uint8)
        Image.fromarray(rgb).save(Path(into, view["render"]))
        Image.fromarray(np.full(size, 51, np.uint8)).save(Path(into, view["alpha"]))
    first = Path(into, "renders", "6", "000000.png")
    if behaviour == "link":
        first.rename(Path(into, "elsewhere.png"))
        first.symlink_to(Path(into, "elsewhere.png"))
    if behaviour == "folder_link":
        first.parent.rename(Path(into, "elsewhere"))
        first.parent.symlink_to(Path(into, "elsewhere"))
    if behaviour == "deep":
        Image.fromarray(np.zeros((64, 96), np.uint16)).save(first)
    if behaviour == "damaged":
        first.write_bytes(first.read_bytes()[:-40])
    if behaviour in ("good", "not_finite", "short"):
        positions = np.zeros((len({view["frame"] for view in listed["views"]}) - (behaviour == "short"), 2, 3))
        positions[0, 0, 0] = np.nan if behaviour == "not_finite" else 0.0
        np.savez(Path(into, "particles.npz"), positions=positions, active=np.ones(positions.shape[:2], bool))


if __name__ == "__main__":
    {"fit": fit, "render": render}[sys.argv[1]](*sys.argv[2:])
