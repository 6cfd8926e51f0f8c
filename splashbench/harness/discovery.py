"""Finding methods: those registered under the entry-point group `splashbench.methods`, and files given by path."""

from __future__ import annotations

import difflib
import importlib.util
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from splashbench.errors import SplashbenchError
from splashbench.harness.contract import Method, MethodConfig

GROUP = "splashbench.methods"
#: The control that the harness writes itself, since no method sees a test image (oracle.py).
ORACLE = "oracle"
#: What is no method either: a code that runs by its own commands (external/).
EXTERNAL = "external"
# What a module from elsewhere may raise: a script that was taken for a method calls sys.exit().
_ANYTHING = (Exception, SystemExit)


def registered() -> dict[str, EntryPoint]:
    """Method id -> entry point, sorted; nothing is imported."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def load_method(name: str) -> Method:
    """The method registered as `name`, or `FILE.py:CLASS` from a file that is not installed.

    Raises SplashbenchError when there is none of that name or its module cannot be imported.
    """
    if ":" in name:
        return _checked(class_from_file(name), name)
    points = registered()
    if name not in points:
        near = difflib.get_close_matches(name, [*points, ORACLE, EXTERNAL], n=1)
        hint = f"did you mean {near[0]!r}?" if near else "see `splashbench methods list`"
        raise SplashbenchError(f"there is no method {name!r}; {hint}")
    return _checked(load_point(points[name]), name)


def load_point(point: EntryPoint) -> Any:
    """What the entry point names. Raises SplashbenchError where its module cannot be imported."""
    try:
        return point.load()
    except ImportError as error:
        raise SplashbenchError(f"method {point.name!r} cannot be imported ({error}); install what it needs") from None
    except _ANYTHING as error:
        raise SplashbenchError(
            f"method {point.name!r} cannot be imported ({type(error).__name__}: {error}); fix or remove its package"
        ) from None


def class_from_file(name: str) -> Any:
    """What `FILE.py:CLASS` names. Raises SplashbenchError where there is no such file or class."""
    file, _, class_name = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise SplashbenchError(f"{path} does not exist; a method that is not installed is given as FILE.py:CLASS")
    module_name = f"splashbench_user_method_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise SplashbenchError(f"{path} is no Python file; a method is given as FILE.py:CLASS")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except _ANYTHING as error:
        raise SplashbenchError(f"{path} cannot be imported ({type(error).__name__}: {error}); fix it") from None
    if not hasattr(module, class_name):
        raise SplashbenchError(f"{path} has no class {class_name!r}; name the method's class after the colon")
    return getattr(module, class_name)


def _checked(method_class: type, name: str) -> Method:
    if not (isinstance(method_class, type) and issubclass(method_class, Method)):
        raise SplashbenchError(f"{name!r} is not a splashbench.Method; subclass it")
    missing = sorted(getattr(method_class, "__abstractmethods__", ()))
    for attribute in ("id", "title"):
        if not hasattr(method_class, attribute):
            missing.append(attribute)
    if missing:
        raise SplashbenchError(f"method {name!r} lacks {', '.join(missing)}; see CONTRIBUTING.md")
    config = method_class.Config
    if not (isinstance(config, type) and issubclass(config, MethodConfig) and config.presets):
        raise SplashbenchError(f"the Config of method {name!r} is no MethodConfig with a preset; see CONTRIBUTING.md")
    try:
        return method_class()
    except _ANYTHING as error:
        raise SplashbenchError(f"method {name!r} cannot be made ({type(error).__name__}: {error}); fix it") from None
