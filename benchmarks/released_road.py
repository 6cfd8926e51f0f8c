"""The whole road of the released scenes on an imitation of their archive: from a local server to the leaderboard.

    python benchmarks/released_road.py road WORK            # 20 scenes, one of 3840x2160: wall time and peak memory
    python benchmarks/released_road.py kills WORK           # two scenes, killed twenty times: the same results
    python benchmarks/released_road.py road WORK --methods hull_points nearest_camera --large 3840x2160

Prints one JSON object. WORK is emptied first where it was made by an earlier run.
"""

from __future__ import annotations

import argparse
import http.server
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from splashbench.files import list_files, sha256_file
from splashbench.synth.release import Imitation, imitations, write_release

_MARK = ".released_road"
_PAGE = (
    b'<html><form id="download-form" action="/download"><input type="hidden" name="confirm" value="t"></form></html>'
)
#: Fields of a result that differ between two runs of one thing: what was measured, and digests of what holds it.
MEASURED = ("fit_seconds", "render_fps", "peak_memory_bytes", "peak_device_memory_bytes")
MEASURED_PARTS = ("stages",)
MEASURED_DIGESTS = ("submission", "reference")


@contextmanager
def drive(archive: Path) -> Iterator[str]:
    """Serve `archive` as the drive does: a page with a form first, then the file, with ranges."""

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            try:
                self.answer()
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True

        def answer(self) -> None:
            size = archive.stat().st_size
            if not self.path.startswith("/download?"):
                page = _PAGE
                self.send_response(200)
                self.send_header("Content-Type", "text/html")
                self.send_header("Content-Length", str(len(page)))
                self.end_headers()
                self.wfile.write(page)
                return
            wanted = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
            start = int(wanted[1]) if wanted else 0
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Content-Length", str(size - start))
            self.end_headers()
            with archive.open("rb") as stream:
                stream.seek(start)
                shutil.copyfileobj(stream, self.wfile)

        def log_message(self, *words: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/uc"
    finally:
        server.shutdown()
        server.server_close()


def command(words: list[str], work: Path) -> list[str]:
    os.environ["SPLASHBENCH_CACHE"] = str(work / "cache")
    return [sys.executable, "-m", "splashbench", *words]


def timed(words: list[str], work: Path) -> dict[str, float]:
    """Run a command; its wall time, and the peak memory of the largest of its processes."""
    start = time.monotonic()
    process = subprocess.Popen(command(words, work))
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{words} ended with {process.returncode}")
    return {
        "seconds": round(time.monotonic() - start, 1),
        "processor_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_gib": round(usage.ru_maxrss / 2**20, 2),
    }


def make_archive(path: Path, scenes: list[Imitation]) -> None:
    """In a process of its own: a command that this one starts would count its memory as the command's."""
    child = multiprocessing.get_context("spawn").Process(target=write_release, args=(path, scenes))
    child.start()
    child.join()
    if child.exitcode:
        sys.exit("the archive was not made")


def road(work: Path, methods: list[str], large: tuple[int, int], frames: int) -> dict[str, Any]:
    """All 20 scenes from the server to the leaderboard; then the large one as recorded."""
    scenes = imitations()
    scenes[0] = replace(scenes[0], size=large, frames=frames)
    archive = work / "served.zip"
    make_archive(archive, scenes)
    real, found = work / "real", {"archive_bytes": archive.stat().st_size, "methods": methods}
    with drive(archive) as url:
        found["download"] = timed(["download", "scenes", str(real), "--url", url, "--variant", "full", "crop"], work)
    found["again"] = timed(["download", "scenes", str(real), "--url", url, "--variant", "full", "crop"], work)
    words = ["benchmark", "run", str(work / "large"), "--scenes", str(real / "real_scene" / scenes[0].name)]
    found["large"] = timed([*words, "--methods", *methods], work)
    words = ["benchmark", "run", str(work / "out"), "--scenes", "all", "--methods", *methods]
    found["run"] = timed(words, work)
    found["run_again"] = timed(words, work)
    rows = (work / "out" / "leaderboard" / "leaderboard.csv").read_text().splitlines()
    found["rows"] = len(rows) - 1
    found["disk_bytes"] = list_files(work / "out").bytes
    return found


def without_times(out: Path) -> dict[str, str]:
    """Every result by method and scene as text, without what is measured."""
    found = {}
    for path in sorted((out / "results").glob("*.json")):
        data = json.loads(path.read_text())
        for name in MEASURED:
            data["metrics"].pop(name, None)
        for name in MEASURED_PARTS:
            data.pop(name, None)
        for name in MEASURED_DIGESTS:
            data["digests"].pop(name, None)
        found[f"{data['method']} {data['scene']}"] = json.dumps(data, sort_keys=True)
    return found


def scene_files(folder: Path) -> dict[str, str]:
    return {name: sha256_file(folder / name) for name in list_files(folder).names if not name.endswith(".lock")}


def kills(work: Path, methods: list[str], count: int) -> dict[str, Any]:
    """Two scenes, once undisturbed and once killed `count` times on the way."""
    scenes = imitations(["bowl_001", "tank_002"])
    archive = work / "served.zip"
    make_archive(archive, scenes)
    draw, killed, at = random.Random(31), 0, []
    with drive(archive) as url:

        def steps(name: str) -> list[list[str]]:
            real, out = work / name / "real", work / name / "out"
            download = ["download", "scenes", "bowl_001", "tank_002", str(real), "--url", url]
            return [download, ["benchmark", "run", str(out), "--scenes", str(real), "--methods", *methods]]

        whole = 0.0
        for step in steps("whole"):
            start = time.monotonic()
            subprocess.run(command(step, work), check=True, stderr=subprocess.DEVNULL)
            whole += time.monotonic() - start
        for _ in range(count):
            moment = draw.uniform(0.0, 0.35 * whole)
            end = time.monotonic() + moment
            for step in steps("killed"):
                process = subprocess.Popen(command(step, work), stderr=subprocess.DEVNULL, start_new_session=True)
                while process.poll() is None and time.monotonic() < end:
                    time.sleep(0.02)
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
                    killed += 1
                    at.append(f"{step[0]} after {moment:.1f} s")
                    break
        for step in steps("killed"):
            subprocess.run(command(step, work), check=True, stderr=subprocess.DEVNULL)
    undisturbed, disturbed = without_times(work / "whole" / "out"), without_times(work / "killed" / "out")
    files = [scene_files(work / name / "real" / "real_scene_crop") for name in ("whole", "killed")]
    return {
        "killed": killed,
        "at": at,
        "whole_seconds": round(whole, 1),
        "results": len(disturbed),
        "results_the_same": undisturbed == disturbed,
        "scenes_the_same": files[0] == files[1],
        "leftovers": [str(path) for path in (work / "killed").rglob(".tmp-*")],
        "aside": [*MEASURED, *MEASURED_PARTS, *(f"digests.{name}" for name in MEASURED_DIGESTS)],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("road", "kills"))
    parser.add_argument("work", type=Path)
    parser.add_argument("--methods", nargs="+", default=["hull_points", "nearest_camera"])
    parser.add_argument("--large", default="3840x2160")
    parser.add_argument("--frames", type=int, default=2, help="of the large scene")
    parser.add_argument("--kills", type=int, default=20)
    arguments = parser.parse_args()
    work: Path = arguments.work.resolve()
    if work.exists() and any(work.iterdir()):
        if not (work / _MARK).is_file():
            sys.exit(f"{work} holds files of something else; give a new folder")
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    (work / _MARK).write_text("Made by benchmarks/released_road.py.\n")
    width, height = map(int, arguments.large.split("x"))
    if arguments.what == "road":
        found = road(work, arguments.methods, (width, height), arguments.frames)
    else:
        found = kills(work, arguments.methods, arguments.kills)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
