"""Methods given as FILE.py:CLASS: a class that cannot be run is refused with one line that names the remedy."""

from pathlib import Path

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness.discovery import load_method

START = """
from splashbench import Method, MethodConfig

class Complete(Method):
    id, title = "complete", "a method"
    def fit(self, scene, config, run): ...
    def load(self, directory, scene): ...
"""


def _load(tmp_path: Path, rest: str, name: str) -> None:
    path = tmp_path / "method.py"
    path.write_text(START + rest)
    load_method(f"{path}:{name}")


@pytest.mark.parametrize(
    ("rest", "reason"),
    [
        ("class Bad(Method):\n    id = 'bad'\n", "lacks fit, load, title; see CONTRIBUTING.md"),
        (
            "class Bad(Complete):\n    class Config(MethodConfig):\n        presets = {}\n",
            "MethodConfig with a preset",
        ),
        ("class Bad(Complete):\n    Config = dict\n", "MethodConfig with a preset"),
        ("class Bad: ...\n", "is not a splashbench.Method; subclass it"),
        ("Bad = Complete()\n", "is not a splashbench.Method; subclass it"),
        ("class Bad(Complete):\n    def __init__(self): 1 / 0\n", "cannot be made .ZeroDivisionError: .*; fix it"),
        ("raise SystemExit(2)\n", "cannot be imported .SystemExit: 2.; fix it"),
        ("", "has no class 'Bad'"),
    ],
)
def test_what_is_no_method_is_refused(tmp_path: Path, rest: str, reason: str) -> None:
    _load(tmp_path, "", "Complete")
    with pytest.raises(SplashbenchError, match=reason):
        _load(tmp_path, rest, "Bad")
