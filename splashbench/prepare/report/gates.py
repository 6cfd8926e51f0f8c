"""The gates in the report: every figure with its unit beside its limit, and what to do about those that failed."""

from __future__ import annotations

from splashbench.pages.blocks import Block, Bullets, Note, Table
from splashbench.prepare.gate import Gate
from splashbench.prepare.preparation import Preparation

# By gate; what is not listed is a share, a count or a ratio, and has none.
_UNITS = {
    "held_out_reprojection": "px",
    "lens_fits": "px",
    "clock_residual": "s",
    "clock_interval": "s",
    "direct_sound": "s",
    "sequence_sync": "s",
    "camera_shift": "px",
    "mean_reprojection": "px",
    "poses_fit": "px",
    "centre_sigma": "m",
    "centre_sigma_of_features": "m",
    "rotation_sigma_of_features": "deg",
    "container_outline": "px",
    "container_sigma": "m",
    "container_clicks": "px",
    "container_clicks_fit": "px",
    "container_upright": "deg",
}


def gates_section(preparation: Preparation) -> list[Block]:
    """A table of all gates, then what to film or to correct for each that failed."""
    rows = [
        [
            gate.name.replace("_", " "),
            gate.figure if gate.finite is None else _with_unit(gate.figure, gate),
            _with_unit(f"{gate.side} {gate.limit:.4g}", gate),
            "passed" if gate.passed else "failed",
            "stops" if gate.essential else "warns",
            gate.detail,
        ]
        for gate in preparation.gates
    ]
    classes = ["passed" if gate.passed else "failed" for gate in preparation.gates]
    blocks: list[Block] = [Table(["gate", "value", "limit", "outcome", "a failure", "what it is"], rows, classes)]
    if preparation.warnings:
        remedies = [f"{gate.name.replace('_', ' ')}: {gate.remedy}" for gate in preparation.warnings]
        blocks += [Note("What to do about the gates that failed:"), Bullets(remedies)]
    return blocks


def _with_unit(text: str, gate: Gate) -> str:
    return f"{text} {_UNITS[gate.name]}" if gate.name in _UNITS else text
