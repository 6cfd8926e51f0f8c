"""The child process that runs SPlisHSPlasH.

Apart from this file nothing imports pysplishsplash: its Linux wheel can end the process without a word, and a process
of its own turns that into an exit status (`splashbench.synth.liquid.simulation` is the parent). Prints the simulated
time, a line per snapshot, on standard output; whatever the solver says goes to standard error.
"""

from __future__ import annotations

import ctypes
import os
import tempfile
from typing import Any

import numpy as np

# The wheel segfaults at import unless the system's libGL is in the process already.
PRELOADED_LIBRARIES = ("libGL.so.1", "libX11.so.6")
TABLE_HEIGHT = 0.0025  # metres: of the centres of particles that lie on the table
REACH = 0.5  # metres: nothing beyond it is of interest


def solve(scene_file: str, output: str, step_seconds_text: str) -> int:
    """Run the scene in the file `scene_file`, with a snapshot every so many simulated seconds.

    Writes times [S], counts [S] and all snapshots' ids, positions and velocities, concatenated, into `output`.
    """
    progress = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the solver logs to standard output, which here belongs to the progress lines
    step_seconds = float(step_seconds_text)
    for library in PRELOADED_LIBRARIES:
        ctypes.CDLL(library)
    import pysplishsplash as sph

    times: list[float] = []
    fields: dict[str, list[Any]] = {"id": [], "position": [], "velocity": []}
    simulator = sph.Exec.SimulatorBase()
    with tempfile.TemporaryDirectory() as scratch:
        simulator.init(sceneFile=scene_file, useGui=False, initialPause=False, useCache=False, outputDir=scratch)
        simulator.initSimulation()
        clock = sph.TimeManager.getCurrent()
        fluid = sph.Simulation.getCurrent().getFluidModel(0)

        def after_step() -> None:
            time = clock.getTime()
            count = fluid.numActiveParticles()
            positions = np.asarray(fluid.getFieldBuffer("position"))[:count]
            # The table: drops stick where they land. A boundary of particles that wide would cost more than the liquid,
            # and drops that fall for ever shrink the time step of all. The buffers are the solver's own memory.
            landed = positions[:, 1] < TABLE_HEIGHT
            positions[landed, 1] = TABLE_HEIGHT
            landed |= (np.abs(positions) > REACH).any(axis=1)
            np.asarray(fluid.getFieldBuffer("velocity"))[:count][landed] = 0
            if times and time < times[-1] + step_seconds:
                return
            for name, store in fields.items():
                store.append(np.array(np.asarray(fluid.getFieldBuffer(name))[:count]))
            times.append(time)
            print(f"{time:.6f}", file=progress, flush=True)

        simulator.setTimeStepCB(after_step)
        simulator.runSimulation()
        np.savez(
            output,
            times=np.array(times),
            counts=np.array([len(ids) for ids in fields["id"]]),
            ids=np.concatenate(fields["id"]).astype(np.int64).ravel(),
            positions=np.concatenate(fields["position"]).astype(np.float32),
            velocities=np.concatenate(fields["velocity"]).astype(np.float32),
        )
        simulator.cleanup()
    return 0
