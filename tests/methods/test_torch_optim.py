"""Methods that say they need no optimiser of torch.optim load no compiler of PyTorch's within their clock."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from splashbench import toml
from splashbench.harness.discovery import load_method

SETTINGS = toml.load(Path(__file__).with_name("small_fits.toml"))

# One process for all of them; once one has loaded it, those after it are told of as well.
PROGRAM = """
import json, sys
from pathlib import Path
from splashbench.harness.contract import Run
from splashbench.harness.discovery import load_method
from splashbench.scene import Scene
from splashbench_methods.scaffold_gs import BackgroundSettings

BackgroundSettings.presets["quick"] = BackgroundSettings.presets["quick"] | {"iterations": 20}
scene = Scene.open(Path(sys.argv[1])).training()
for name, settings in json.loads(sys.argv[2]).items():
    method = load_method(name)
    preset = "quick" if "quick" in method.Config.presets else next(iter(method.Config.presets))
    method.fit(scene, method.Config.preset(preset, settings), Run(seed=0))
    print(name, "torch._dynamo" in sys.modules, flush=True)
"""


@pytest.mark.slow
def test_a_fit_loads_the_compiler_only_where_its_method_says_so(balls_directory: Path) -> None:
    without = {name: settings for name, settings in SETTINGS.items() if not load_method(name).torch_optim}
    assert {"splashsplat", "scaffold_4d", "spacetime_gaussians", "nothing"} <= set(without)
    command = [sys.executable, "-c", PROGRAM, str(balls_directory), json.dumps(without)]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    assert found.stdout.splitlines() == [f"{name} False" for name in without]
