"""What a study is: a TOML file that names method, budget, scenes, seeds and variants (docs/study.md).

Specs that are shipped lie in specs/ and are given by name.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, field_validator, model_validator

from splashbench import toml
from splashbench.errors import SplashbenchError
from splashbench.files import validate_model
from splashbench.score.metrics import METRICS, Metric
from splashbench.study.perturbations import Perturbation
from splashbench.submission import RENAMED_FIGURES
from splashbench.submission.withheld import Withheld

#: Metrics that follow from others, tabulated here alone: sigma_D over mu_D is what the paper's Table S7 gives.
DERIVED: dict[str, tuple[Metric, str, str]] = {
    "sigma_mu_ratio": (
        Metric("sigma_mu_ratio", "σ_D/μ_D", "", "lower", 3, "paper, supplement, Table S7", "particles"),
        "sigma_d",
        "mu_d",
    )
}
_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.+-]{0,59}$"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SceneEntry(_Model):
    """A scene by its folder. Tables call it `name`; by default the name that the scene gives itself."""

    path: str
    name: str | None = Field(default=None, pattern=_NAME)


class StudyVariant(_Model):
    """One row of the table: what it changes. `paper`: its name in leaderboards/paper.csv.

    method: another one than the study's, with its own preset (by default its first) and settings, without `base`.

    train_views: a number (nested subsets that bracket the test views) or the names of the training views kept.
    withheld: timesteps that the method does not see, and that alone are scored (submission/withheld.py).
    """

    name: str = Field(pattern=_NAME)
    note: str = ""
    method: str | None = None
    preset: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    perturbation: tuple[Perturbation, ...] = ()
    train_views: Annotated[int, Field(ge=2)] | tuple[str, ...] | None = None
    withheld: Withheld | None = None
    paper: str | None = None

    @model_validator(mode="after")
    def _withheld_once(self) -> StudyVariant:
        if len(self._all_withheld) > 1:
            raise ValueError(f"timesteps are withheld twice: {' and '.join(self._all_withheld)}")
        return self

    @property
    def _all_withheld(self) -> list[str]:
        of_steps = [step.withheld for step in self.perturbation]
        return [which for which in (self.withheld, *of_steps) if which is not None]

    @property
    def unseen(self) -> Withheld | None:
        """Timesteps that the method does not see, whether they are `withheld` or a step of the perturbation's."""
        return next(iter(self._all_withheld), None)

    @property
    def harm(self) -> tuple[Perturbation, ...]:
        """The steps of the perturbation that change what is seen."""
        return tuple(step for step in self.perturbation if step.withheld is None)


class Reference(_Model):
    """The control that dpsnr_bg is measured against, run on every scene and seed."""

    method: Literal["nothing"] = "nothing"
    preset: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)


class Paper(_Model):
    """Where the paper's figures are: the `scene_set` of leaderboards/paper.csv."""

    scene_set: str


class StudySpec(_Model):
    """A whole study. `base`: the budget, settings of every row of `method` on top of its preset.

    reference: false in TOML leaves the control out. timeout_seconds: for each fit, and again for each rendering.
    """

    name: str = Field(pattern=_NAME)
    title: str = ""
    method: str
    preset: str | None = None
    base: dict[str, Any] = Field(default_factory=dict)
    scenes: tuple[SceneEntry, ...] = ()
    seeds: tuple[NonNegativeInt, ...] = Field(default=(0, 1, 2), min_length=1)
    metrics: tuple[str, ...] = Field(min_length=1)
    baseline: str
    variants: tuple[StudyVariant, ...] = Field(min_length=1)
    reference: Reference | None = Reference()
    paper: Paper | None = None
    device: str = "cpu"
    timeout_seconds: PositiveFloat | None = None

    @field_validator("scenes", mode="before")
    @classmethod
    def _paths(cls, value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [{"path": entry} if isinstance(entry, str) else entry for entry in value]
        return value

    @field_validator("reference", mode="before")
    @classmethod
    def _left_out(cls, value: Any) -> Any:
        return None if value is False else value

    @field_validator("metrics")
    @classmethod
    def _known_metrics(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        names = [*METRICS, *DERIVED]
        for name in value:
            if name in RENAMED_FIGURES:
                raise ValueError(f"metric {name!r} is called {RENAMED_FIGURES[name]!r} now; change the name")
            if name not in names:
                raise ValueError(f"there is no metric {name!r}{_near(name, names)}")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> StudySpec:
        names = self.names
        for what, values in (("variant", names), ("seed", self.seeds), ("metric", self.metrics)):
            repeated = next((value for value in values if list(values).count(value) > 1), None)
            if repeated is not None:
                raise ValueError(f"{what} {repeated} is listed twice")
        if self.baseline not in names:
            raise ValueError(f"baseline {self.baseline!r} is no variant{_near(self.baseline, names)}")
        if self.reference is not None and self.reference.method in names:
            raise ValueError(f"a variant may not be called {self.reference.method!r}: so is the reference's row")
        return self

    @property
    def names(self) -> list[str]:
        """Of the variants, in order."""
        return [variant.name for variant in self.variants]

    def variant(self, name: str) -> StudyVariant:
        """The variant called `name`. Raises SplashbenchError where there is none."""
        for variant in self.variants:
            if variant.name == name:
                return variant
        names = self.names
        raise SplashbenchError(f"study {self.name} has no variant {name!r}{_near(name, names)}; it has {_list(names)}")


def shipped() -> dict[str, Path]:
    """Name -> file of the specs that come with splashbench."""
    folder = Path(str(files("splashbench.study").joinpath("specs")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_spec(
    name: str,
    *,
    scenes: Sequence[str] = (),
    seeds: Sequence[int] = (),
    base: Mapping[str, Any] | None = None,
) -> StudySpec:
    """The spec shipped as `name`, or in the file `name`. `scenes` and `seeds` replace its own, `base` adds to its own.

    Paths in a file are relative to the file. Raises SplashbenchError, one line, for what is wrong with it.
    """
    path = Path(name)
    if path.suffix != ".toml":
        if name not in shipped():
            hint = _near(name, list(shipped()))
            raise SplashbenchError(
                f"there is no study {name!r}{hint}; give one of {_list(list(shipped()))}, or a file NAME.toml"
            )
        path = shipped()[name]
    data = toml.load(path)
    if isinstance(data.get("scenes"), list):
        data["scenes"] = [_placed(entry, path.parent) for entry in data["scenes"]]
    if scenes:
        data["scenes"] = list(scenes)
    if seeds:
        data["seeds"] = list(seeds)
    if base and isinstance(data.get("base", {}), dict):
        data["base"] = {**data.get("base", {}), **base}
    spec = validate_model(path, StudySpec, data)
    if not spec.scenes:
        raise SplashbenchError(f"study {spec.name} names no scenes; give some with --scenes")
    return spec


def _placed(entry: Any, folder: Path) -> Any:
    if isinstance(entry, str):
        return str(folder / entry)
    if isinstance(entry, dict) and isinstance(entry.get("path"), str):
        return {**entry, "path": str(folder / entry["path"])}
    return entry


def metric_of(name: str) -> Metric:
    """The registry's entry of metric `name`, or that of a derived one."""
    return DERIVED[name][0] if name in DERIVED else METRICS[name]


def _near(name: str, names: list[str]) -> str:
    matches = difflib.get_close_matches(name, names, n=1)
    return f", did you mean {matches[0]!r}?" if matches else ""


def _list(names: list[str]) -> str:
    return ", ".join(names)
