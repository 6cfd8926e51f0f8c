"""The pour: divergence-free SPH (Bender and Koschier 2015) of a stream falling into the bowl, run in a child process.

The solver is SPlisHSPlasH. With one thread and regular boundary sampling its results repeat bit for bit, so a seed
and a particle radius always give the same liquid. Its settings follow what holds at this scale: surface tension after
Jeske et al. 2023 (other models go unstable), particles of 2 to 5 mm radius.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splashbench.child import child_command
from splashbench.errors import SplashbenchError
from splashbench.files import read_npz
from splashbench.progress import Bar
from splashbench.synth.imaging.geometry import Mesh
from splashbench.synth.liquid.solver import PRELOADED_LIBRARIES, solve
from splashbench.synth.liquid.trajectory import Trajectory, assemble

SNAPSHOT_SECONDS = 0.002
TIMEOUT_SECONDS = 3600.0
# The solver, and what rendering its result takes: told before an hour is spent, not after.
_PACKAGES = ("pysplishsplash", "pysplashsurf", "embreex")


@dataclass(frozen=True)
class Pour:
    """What is poured. Lengths in metres, times in seconds from the start of the simulation, speed in m/s."""

    duration: float = 2.0
    emit_until: float = 1.3
    particle_radius: float = 0.003
    stream_diameter: float = 0.024
    speed: float = 1.1
    nozzle: tuple[float, float, float] = (-0.075, 0.33, 0.0)
    angle_degrees: float = -72.0  # of the stream against the x axis, in the x-y plane
    azimuth_degrees: float = 0.0  # of that plane about the y axis

    def placed(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The nozzle [3] and the unit direction [3] of the stream, turned by the azimuth."""
        angle, azimuth = np.radians(self.angle_degrees), np.radians(self.azimuth_degrees)
        turn = np.array([[np.cos(azimuth), 0, np.sin(azimuth)], [0, 1, 0], [-np.sin(azimuth), 0, np.cos(azimuth)]])
        direction = turn @ np.array([np.cos(angle), np.sin(angle), 0.0])
        return (turn @ np.array(self.nozzle)).astype(np.float32), direction.astype(np.float32)


def check_libraries(load: Callable[[str], object] = ctypes.CDLL) -> None:
    """Raise SplashbenchError unless the system has the libraries that the solver's wheel needs."""
    for library in PRELOADED_LIBRARIES:
        try:
            load(library)
        except OSError:
            raise SplashbenchError(
                f"the liquid solver pysplishsplash needs {library}, which this system lacks; "
                "install the Debian packages libgl1 and libx11-6"
            ) from None


def check_packages() -> None:
    """Raise SplashbenchError unless the packages of the extra `synth` are installed."""
    for package in _PACKAGES:
        if importlib.util.find_spec(package) is None:
            raise SplashbenchError(
                f"synthetic liquids need the package {package}, which is missing; "
                "install it in a checkout: pip install -c constraints.txt -e '.[synth]'"
            )


class RunningSimulation:
    """A simulation in its child process; `finish` waits for it. Made by `start`."""

    def __init__(self, pour: Pour, directory: Path, process: subprocess.Popen[str], timeout: float) -> None:
        self._pour, self._directory, self._process, self._timeout = pour, directory, process, timeout
        self._timed_out = False
        self._timer = threading.Timer(timeout, self._give_up)
        self._timer.daemon = True
        self._timer.start()

    def _give_up(self) -> None:
        self._timed_out = True
        self._process.kill()

    def stop(self) -> None:
        """End the child process if it still runs; harmless afterwards."""
        self._timer.cancel()
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def finish(self) -> Trajectory:
        """Wait, showing a bar, and read the result. Raises SplashbenchError when the solver failed or hung."""
        bar = Bar("liquid simulation")
        assert self._process.stdout is not None
        for line in self._process.stdout:
            bar.update(float(line) / self._pour.duration)
        status = self._process.wait()
        bar.close()
        self.stop()
        if self._timed_out:
            raise SplashbenchError(
                f"the liquid solver had not finished after {self._timeout:.0f} s; give a larger --particle-radius"
            )
        output = self._directory / "snapshots.npz"
        if status != 0 or not output.is_file():
            lines = (self._directory / "solver.log").read_text(errors="replace").strip().splitlines()
            reason = f"signal {-status}" if status < 0 else (lines[-1] if lines else f"exit status {status}")
            raise SplashbenchError(
                f"the liquid solver pysplishsplash ended early ({reason}); "
                "check that libgl1 and libx11-6 are installed and try another --particle-radius"
            )
        arrays = read_npz(output, {"times": 1, "counts": 1, "ids": 1, "positions": 2, "velocities": 2})
        nozzle, direction = self._pour.placed()
        try:
            return assemble(arrays, nozzle, direction)
        except ValueError as error:
            raise SplashbenchError(
                f"the simulation of the pour is unusable: {error}; try another --particle-radius"
            ) from None


def start(pour: Pour, container: Mesh, directory: Path, timeout: float = TIMEOUT_SECONDS) -> RunningSimulation:
    """Start simulating `pour` into `container`, with files in the existing folder `directory`."""
    check_packages()
    check_libraries()
    directory = directory.resolve()  # the solver dies without a word on a relative path
    scene_file = directory / "solver.json"
    scene_file.write_text(json.dumps(_solver_scene(pour, container, directory)), encoding="utf-8")
    # One thread, and passive waiting: results that repeat, and a core left to the renderer.
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    command = child_command(solve, scene_file, directory / "snapshots.npz", str(SNAPSHOT_SECONDS))
    with (directory / "solver.log").open("w") as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=environment, text=True)
    return RunningSimulation(pour, directory, process, timeout)


def _solver_scene(pour: Pour, container: Mesh, directory: Path) -> dict[str, Any]:
    """The scene description SPlisHSPlasH reads; writes the bowl's OBJ file into `directory`."""
    _write_obj(directory / "container.obj", container.vertices, container.faces)
    nozzle, _ = pour.placed()
    # The solver turns its x axis by one rotation about one axis: the tilt, then the azimuth.
    axis, angle = _axis_angle(np.radians(pour.azimuth_degrees), np.radians(pour.angle_degrees))
    bowl = {
        "geometryFile": str(directory / "container.obj"),
        "translation": [0, 0, 0],
        "scale": [1, 1, 1],
        "rotationAxis": [1, 0, 0],
        "rotationAngle": 0,
        "isDynamic": False,
        "samplingMode": 1,  # regular triangles; the default draws random points
    }
    return {
        "Configuration": {
            "particleRadius": pour.particle_radius,
            "timeStepSize": 5e-4,
            "simulationMethod": 4,  # DFSPH
            "gravitation": [0, -9.81, 0],
            "cflMethod": 1,
            "cflFactor": 0.9,
            "cflMinTimeStepSize": 1e-5,
            "cflMaxTimeStepSize": 0.002,  # 4 ms lets a calm pool explode
            "boundaryHandlingMethod": 0,  # Akinci et al. 2012
            "stopAt": pour.duration,
            "pause": False,
            "DFSPH": {"maxIterations": 100, "maxError": 0.1, "maxIterationsV": 50, "maxErrorV": 0.5},
        },
        "Materials": [
            {
                "id": "Fluid",
                "density0": 1000,
                "maxEmitterParticles": 100000,
                "viscosityMethod": 1,
                # Without friction at the wall most of the stream shoots out along the bowl's far side; with ten times
                # this there is no splash.
                "Standard viscosity": {"viscosity": 6e-4, "viscosityBoundary": 5e-5},
                "surfaceTensionMethod": 4,
                "Jeske et al. 2023": {"surfaceTension": 0.2, "surfaceTensionViscosity": 3e-4},
            }
        ],
        "RigidBodies": [bowl],
        "FluidBlocks": [],
        "Emitters": [
            {
                "type": 1,  # round
                "width": max(2, round(pour.stream_diameter / (2 * pour.particle_radius))),
                "translation": nozzle.tolist(),
                "rotationAxis": axis.tolist(),
                "rotationAngle": angle,
                "velocity": pour.speed,
                "emitStartTime": 0.0,
                "emitEndTime": pour.emit_until,
            }
        ],
    }


def _axis_angle(azimuth: float, tilt: float) -> tuple[NDArray[np.float64], float]:
    """The rotation `tilt` about z followed by `azimuth` about y, as a unit axis [3] and an angle in radians."""
    from scipy.spatial.transform import Rotation

    vector = (Rotation.from_euler("y", azimuth) * Rotation.from_euler("z", tilt)).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return vector / angle, angle


def _write_obj(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.integer[Any]]) -> None:
    lines = ["v {:.8g} {:.8g} {:.8g}".format(*vertex) for vertex in vertices.tolist()]
    lines += ["f {} {} {}".format(*face) for face in (faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
