"""What the leaderboard's page holds, as plain data: groups with their statistics, runs, and rows of the table.

The page's script draws and filters; every statistic is computed here.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from splashbench.errors import one_line
from splashbench.report.anytime import (
    MAX_DRAWN,
    QUALITY,
    before,
    by_scene,
    chases,
    curves,
    hypervolumes,
    standings,
)
from splashbench.report.decision_text import BASES, chosen_rung, rung_table, shortened
from splashbench.report.groups import Entry, Group, comparable, told_text
from splashbench.report.results import claimed_text, shown_differences
from splashbench.score.metrics import METRICS
from splashbench.score.notation import FILTER_MARK, NO_FIGURE, in_shown_unit, label, shown
from splashbench.score.result import Result
from splashbench.score.verification import Verification
from splashbench.statistics import Estimate, estimate
from splashbench.submission import Decision

#: Metrics of the table, of the charts' axes, and of a run's details.
TABLE = ("psnr", "lpips", "ssim", "miou", "spill", "jitter_error", "fit_seconds", "peak_memory_bytes", "storage_bytes")
COSTS = ("fit_seconds", "peak_memory_bytes", "storage_bytes", "render_fps", "primitives_per_frame")
QUALITIES = (*QUALITY, "dpsnr_bg", "ssim", "spill", "jitter_error", "uniformity")
_SHOWN = tuple(dict.fromkeys((*TABLE, *COSTS, *QUALITIES)))
_DIGITS = 6
#: Of a run in the page, and rungs of a decision; `splashbench explain` shows all.
MAX_DECISIONS, MAX_RUNGS, MAX_NOTES, MAX_STAGES = 20, 15, 60, 60


def metric_facts() -> dict[str, dict[str, Any]]:
    """What the script has to know of each metric that is shown: label, direction, decimals, whether log is natural."""
    return {
        name: {
            "label": label(METRICS[name], arrow=False),
            "title": METRICS[name].title,
            "better": METRICS[name].better,
            "filtered": METRICS[name].filtered,
            "log": METRICS[name].group == "cost",
        }
        for name in _SHOWN
    }


def group_facts(group: Group) -> dict[str, Any]:
    """A group's curves, standings and estimates, over the scenes that its entries have in common; and its chases."""
    shared = comparable(group)
    nothing = {name: before(shared, name) for name in QUALITIES}
    # What `nothing` has over `nothing`, which is scored without that reference.
    nothing["dpsnr_bg"] = dict.fromkeys(nothing["psnr"], 0.0)
    kept = {entry.label for entry in shared.entries}
    return {
        "shared_scenes": list(shared.scenes.values()) if kept else [],
        "left_out": [entry.label for entry in group.entries if entry.label not in kept],
        "machine": group.machine,
        "protocol": group.protocol,
        "told": group.told_text,
        "scenes": list(group.scenes.values()),
        "entries": [entry.label for entry in group.entries],
        "curves": {name: [_curve(curve) for curve in curves(shared, name)] for name in QUALITY},
        "standings": {name: [_standing(name, standing) for standing in standings(shared, name)] for name in QUALITY},
        "estimates": {entry.label: _estimates(nothing, entry) for entry in shared.entries},
        "hypervolumes": {name: _estimate(found) for name, found in hypervolumes(shared).items()},
        "chases": {
            name: [
                {**vars(chase), "ratio": None if math.isinf(chase.ratio) else rounded(chase.ratio)}
                for chase in chases(group, name)
            ]
            for name in ("psnr", "lpips")
        },
    }


def _curve(curve: Any) -> dict[str, Any]:
    ends = [found.interval or (found.value, found.value) for found in curve.estimates]
    return {
        "label": curve.label,
        "x": [rounded(seconds) for seconds in curve.seconds],
        "y": [rounded(found.value) for found in curve.estimates],
        "low": [rounded(low) for low, _ in ends],
        "high": [rounded(high) for _, high in ends],
        "runs": curve.runs,
        "scenes": curve.scenes,
    }


def _standing(name: str, standing: Any) -> dict[str, Any]:
    lead = standing.lead
    return {
        "seconds": standing.seconds,
        "ranking": [{"label": label, **_estimate(found)} for label, found in standing.ranking[:MAX_DRAWN]],
        "lead": None
        if lead is None
        else {
            "difference": _estimate(lead.difference),
            "probability": None if math.isnan(lead.probability) else rounded(lead.probability),
            "scenes": lead.scenes,
            "text": shown(METRICS[name], lead.difference.value),
        },
    }


def _estimate(found: Estimate) -> dict[str, Any]:
    interval = None if found.interval is None else [rounded(end) for end in found.interval]
    return {"value": rounded(found.value), "interval": interval}


def _estimates(nothing: Mapping[str, Mapping[str, float]], entry: Entry) -> dict[str, Any]:
    """Inter-quartile mean of each metric over the entry's runs, and how many there are and failed.

    A failed run has the quality that `nothing` (by metric and scene) has of its scene, where known, and no cost. `runs`
    of a figure says how many it is over: the page marks those that leave some out, since these flatter.
    """
    figures: dict[str, Any] = {}
    fine = [result for result in entry.results if result.status == "ok"]
    for name in _SHOWN:
        values = {(r.digests.scene, r.seed): v for r in fine if (v := r.value(name)) is not None}
        if name in QUALITIES:
            there = nothing[name]
            charged = [r for r in entry.results if r.status != "ok" and r.digests.scene in there]
            values |= {(r.digests.scene, r.seed): there[r.digests.scene] for r in charged}
        if values:
            scale = in_shown_unit(METRICS[name], 1.0)
            found = estimate([scale * part for part in by_scene(values)])
            figures[name] = {**_estimate(found), "runs": len(values)}
    return {
        "figures": figures,
        "runs": len(entry.results),
        "failed": len(entry.results) - len(fine),
        "mixed": entry.first.mixed,
    }


def run_facts(result: Result, group: int, label: str, scene: str, path: str) -> dict[str, Any]:
    """One run: its figures in shown units, its course, and what its details tell.

    scene: its name within the group. path: of its file.
    """
    figures = {
        name: rounded(in_shown_unit(METRICS[name], value))
        for name in _SHOWN
        if (value := result.value(name)) is not None
    }
    course = [
        [rounded(c.seconds), *(None if (value := c.metrics.get(n)) is None else rounded(value) for n in QUALITY)]
        for c in result.checkpoints
        if c.status == "ok"
    ]
    return {
        "group": group,
        "label": label,
        "scene": scene,
        "seed": result.seed,
        "status": result.status,
        "reason": one_line(result.reason),
        "control": result.control,
        "figures": figures,
        "course": course,
        "stages": {shortened(name, 60): rounded(seconds) for name, seconds in list(result.stages.items())[:MAX_STAGES]},
        "notes": {one_line(name): one_line(text) for name, text in list(result.notes.items())[:MAX_NOTES]},
        "decisions": [_decision(decision) for decision in result.decisions[:MAX_DECISIONS]],
        "decisions_left_out": max(0, len(result.decisions) - MAX_DECISIONS),
        "file": path,
        "command": command(result),
        "submission": result.digests.submission[:12],
        "missing": sorted(
            {one_line(m.reason) for n, m in result.metrics.items() if m.value is None and m.reason and n in _SHOWN}
            if result.status == "ok"
            else ()
        ),
    }


def verification_facts(verification: Verification | None) -> dict[str, str]:
    """What scoring the submission of a run again gave, in words; nothing where nobody asked."""
    if verification is None:
        return {}
    words = [verification.verdict, *([shown_differences(verification.differences)] if verification.differences else [])]
    words += [one_line(verification.reason)] if verification.reason else []
    words += [f"not recomputed: {', '.join(verification.unchecked)}"] if verification.unchecked else []
    return {"verification": ": ".join(words)}


def _decision(decision: Decision) -> dict[str, Any]:
    """A decision with its first `MAX_RUNGS` rungs as text: a page holds many runs, some of them strangers'."""
    table = rung_table(decision, 150)
    chosen = chosen_rung(decision)
    return {
        "name": shortened(decision.name, 60),
        "chosen": shortened(decision.chosen, 100),
        "because": f"{BASES[decision.basis]}: {shortened(decision.because, 250)}".rstrip(": "),
        "header": [*table.header, ""],
        "rungs": [[*row, verdict] for row, verdict in zip(table.rows[:MAX_RUNGS], table.verdicts)],
        "held": chosen,
        "rungs_left_out": max(0, len(table.rows) - MAX_RUNGS),
    }


def command(result: Result) -> str:
    """The command that makes the run again, as far as a result tells it: not where files of the method lay.

    It is one line without control characters, since people copy it into a terminal.
    """
    return one_line(_command(result))


def _command(result: Result) -> str:
    scene, settings = f"scenes/{result.scene}", result.settings
    if result.method == "oracle":
        return shlex.join(["splashbench", "run", "oracle", scene, "OUT"])
    if "format" in settings and ("command" in settings or "trained" in settings):
        parts = ["splashbench", "run-external", scene, "OUT", "--name", result.method, "--seed", str(result.seed)]
        options = {"format": "format", "command": "command", "render_command": "render-command", "importer": "import"}
        for name, option in options.items():
            if name in settings:
                parts += [f"--{option}", str(settings[name])]
        return shlex.join(parts)
    parts = ["splashbench", "run", result.method, scene, "OUT"]
    parts += ["--preset", result.preset, "--seed", str(result.seed)]
    # By default a machine with a GPU would take that, whose fits have other bytes.
    parts += ["--device", "cuda" if result.hardware.get("gpu") else "cpu"]
    if result.withheld:
        parts += ["--withhold", result.withheld]
    if result.checkpoints:
        parts.append("--checkpoints")
    for override in result.overrides:
        parts += ["--set", override]
    return shlex.join(parts)


def row_facts(row: pd.Series, group: int, label: str, runs: list[int]) -> dict[str, Any]:
    """A row of the table: medians over seeds in shown units, text as people read it, and numbers to sort by."""
    first: Result = row["results"][0]
    cells: dict[str, list[float | str | None]] = {}
    for name in TABLE:
        value = row[name]
        claimed = claimed_text(name, row["verifications"])
        if value is None or math.isnan(value):
            if claimed:
                cells[name] = [None, NO_FIGURE + claimed]
            continue
        mark = FILTER_MARK if first.mixed and METRICS[name].filtered else ""
        cells[name] = [rounded(in_shown_unit(METRICS[name], value)), shown(METRICS[name], value) + mark + claimed]
    return {
        "scene": first.scene,
        "digest": first.digests.scene[:8],
        "method": first.method,
        "label": label,
        "preset": first.preset,
        "version": first.method_version,
        "settings": first.settings_digest,
        "machine": first.hardware_label,
        "protocol": first.protocol_label,
        "told": told_text(first.told),
        "status": first.status,
        **({"verified": row["verified"]} if row["verified"] else {}),
        "control": first.control,
        "seeds": row["seed"],
        "cells": cells,
        "group": group,
        "runs": runs,
    }


def distinct_settings(results: Iterable[Result]) -> dict[str, Mapping[str, Any]]:
    """Settings by their digest: many runs share them."""
    found = {result.settings_digest: result.settings for result in results}
    # What JSON cannot say, such as NaN in a stranger's file, becomes text.
    return {digest: json.loads(json.dumps(found[digest], default=str), parse_constant=str) for digest in sorted(found)}


def rounded(value: float) -> float | None:
    """`value` to six significant digits; None for what is no number, which JSON cannot hold."""
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
