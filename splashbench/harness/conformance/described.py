"""What a method says of itself, looked over: id, title, presets, and settings that can be written and read back."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pydantic import ValidationError

from splashbench import toml
from splashbench.errors import SplashbenchError, one_line
from splashbench.files import write_text
from splashbench.harness.contract import Method, MethodConfig
from splashbench.harness.runner import without_nulls
from splashbench.submission import Identity, identity_text


def description_faults(name: str, method: Method, preset: str, config: MethodConfig) -> list[str]:
    """A line for each fault of `method`, given as `name`, with the settings `config` of `preset`."""
    faults = []
    if not isinstance(method.title, str) or not method.title.strip() or one_line(method.title) != method.title:
        faults.append(f"title {method.title!r} is no line of text")
    if ":" not in name and method.id != name:
        faults.append(f"its id is {method.id!r}, but it is registered as {name!r}")
    for attribute in ("control", "mixed"):
        if not isinstance(getattr(method, attribute), bool):
            faults.append(f"{attribute} is neither True nor False")
    if "cpu" not in method.devices and "cuda" not in method.devices:
        faults.append(f"devices {method.devices!r} names neither cpu nor cuda")
    for other in method.Config.presets:
        try:
            method.Config.preset(other)
        except SplashbenchError as error:
            faults.append(f"preset {other}: {error}")
    return faults + _settings_faults(method, preset, config)


def _settings_faults(method: Method, preset: str, config: MethodConfig) -> list[str]:
    """Faults of what submission.toml and a request to the child process would say of the run."""
    try:
        if type(config).model_validate_json(config.model_dump_json()) != config:
            return ["its settings are others after being written as JSON and read back"]
        settings = without_nulls(config.model_dump(mode="json"))
        identity = Identity(
            method=method.id,
            method_version=method.version,
            preset=preset,
            settings=settings,
            scene="balls",
            scene_digest="0" * 64,
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "submission.toml")
            write_text(path, identity_text(identity))
            if Identity.model_validate(toml.load(path)) != identity:
                return ["its settings are others after being written as TOML and read back"]
    except ValidationError as error:
        first = error.errors()[0]
        return [f"{'.'.join(map(str, first['loc']))}: {first['msg']}"]
    except (TypeError, ValueError) as error:  # pydantic's own for what JSON cannot say is a ValueError
        return [f"its settings cannot be written: {one_line(str(error))}"]
    return []
