"""`splashbench explain SUBMISSION`: why a fit is as large and as slow as it is."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from splashbench.cli.command import add_command
from splashbench.cli.output import emit, say, table

if TYPE_CHECKING:
    from splashbench.submission import Decision, Record, Submission

_EPILOG = """\
examples:
  splashbench explain submissions/bowl_001/splashsplat
  splashbench explain submissions/bowl_001/splashsplat --out decisions.png

Shows each decision of the method: what was tried, what was bought, what was refused and why; then the fit's stages and
the method's notes. A rung's gain, time and size are over the rung held before it. --out draws a panel per decision, 12
at most. Everything is read from record.json; `splashbench check` says whether that file is as the run wrote it.
"""

_WIDTH = 100
# A record may name any number of stages.
_MAX_STAGES = 30


def register(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = add_command(
        subparsers,
        "explain",
        run,
        summary="why a fit is as large and as slow as it is",
        description="Explain the size and the time of SUBMISSION by what its method tried, bought and refused.",
        epilog=_EPILOG,
    )
    parser.add_argument("submission", type=Path, metavar="SUBMISSION", help="folder of the submission")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also draw the decisions, as .png or .svg")


def run(arguments: argparse.Namespace) -> int:
    """Handle `splashbench explain`."""
    from splashbench.files import require_unsealed_place
    from splashbench.report.decision_chart import require_chart_place
    from splashbench.submission import Submission

    if arguments.out:
        require_chart_place(arguments.out)
        require_unsealed_place(arguments.out)
    submission = Submission.open(arguments.submission, verify=False)
    identity, record = submission.identity, submission.record
    for paragraph in _text(submission):
        say(paragraph)
    left_out = 0
    if arguments.out:
        from splashbench.report.decision_chart import decision_chart

        left_out = decision_chart(f"{identity.method} on {identity.scene}", record.decisions, arguments.out)
        say(f"wrote {arguments.out}{f', without the last {left_out} decisions' if left_out else ''}")
    if arguments.json:
        costs = ("fit_seconds", "storage_bytes", "peak_memory_bytes", "peak_device_memory_bytes")
        emit(
            {"submission": str(arguments.submission)}
            | identity.model_dump(mode="json", include={"method", "method_version", "preset", "seed", "scene"})
            | record.model_dump(mode="json", include={"status", "reason", *costs, "stages", "notes", "decisions"})
            | {"file": str(arguments.out) if arguments.out else None, "decisions_not_drawn": left_out}
        )
    return 0


def _text(submission: Submission) -> Iterator[str]:
    """Paragraphs, the finding first. Each piece of a record is on one line and bounded: it may be a stranger's."""
    record = submission.record
    yield _finding(submission)
    if not record.decisions:
        yield "no decision is recorded: the method took its settings as they are"
    for number, decision in enumerate(record.decisions, 1):
        yield ""
        yield _decision(number, decision)
    if record.stages:
        yield ""
        yield _stages(record)
    if record.notes:
        yield ""
        yield _notes(record)


def _finding(submission: Submission) -> str:
    from splashbench.report.decision_text import BASES, seconds_text, shortened
    from splashbench.score.metrics import METRICS
    from splashbench.score.notation import NO_FIGURE, shown

    identity, record = submission.identity, submission.record
    costs = [f"fit {seconds_text(record.fit_seconds)}"] if record.fit_seconds is not None else []
    for name, value in (("storage_bytes", record.storage_bytes), ("peak_memory_bytes", record.peak_memory_bytes)):
        text = shown(METRICS[name], value)
        if text != NO_FIGURE:
            costs.append(f"{text} MB of storage" if name == "storage_bytes" else f"{text} MiB of memory")
    if record.peak_device_memory_bytes:
        costs.append(f"{record.peak_device_memory_bytes / 2**20:.0f} MiB on the accelerator")
    costs.append(_count(len(record.decisions), "decision"))
    name = f"{identity.method} ({shortened(identity.preset, 60)}, seed {identity.seed})"
    lines = [f"{name} on {shortened(identity.scene, 100)}: {', '.join(costs)}"]
    if record.status.value != "ok":
        lines.append(f"the run ended with status {record.status.value}: {shortened(record.reason, 500) or 'no reason'}")
    if record.decisions:
        rungs = [rung for decision in record.decisions for rung in decision.rungs]
        bought = sum(rung.bought for rung in rungs)
        bases = Counter(BASES[decision.basis] for decision in record.decisions)
        evidence = ", ".join(f"{words} {count}" for words, count in bases.most_common())
        lines.append(
            f"{_count(len(rungs), 'rung')}: {bought} bought, {len(rungs) - bought} refused; decided by {evidence}"
        )
    return "\n".join(lines)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _decision(number: int, decision: Decision) -> str:
    import textwrap

    from splashbench.report.decision_text import BASES, chosen_rung, rung_table, shortened

    head = f"{number}. {shortened(decision.name, 60)}: {shortened(decision.chosen, 100)}"
    because = f"{BASES[decision.basis]}: {shortened(decision.because, 500)}".rstrip(": ")
    lines = [head, textwrap.fill(because, _WIDTH, initial_indent="   ", subsequent_indent="   ")]
    if decision.rungs:
        rungs, chosen = rung_table(decision), chosen_rung(decision)
        heading, *rows = table(rungs.header, rungs.rows).splitlines()
        lines.append(f"     {heading}")
        for i, (row, verdict) in enumerate(zip(rows, rungs.verdicts)):
            lines.append(f"   {'*' if i == chosen else ' '} {row}  {verdict}")
    return "\n".join(lines)


def _stages(record: Record) -> str:
    from splashbench.report.decision_text import seconds_text, shortened

    longest = sorted(record.stages.items(), key=lambda stage: -stage[1])
    # Stages may overlap and the fit's seconds may be missing: a share is told of the fit alone.
    total = record.fit_seconds
    rows = [
        [shortened(name, 40), seconds_text(seconds), f"{seconds / total:.0%}" if total else "-"]
        for name, seconds in longest[:_MAX_STAGES]
    ]
    text = table(["stage", "time", "of the fit"], rows)
    return text + (f"\nand {len(longest) - _MAX_STAGES} shorter stages" if len(longest) > _MAX_STAGES else "")


def _notes(record: Record) -> str:
    import textwrap

    from splashbench.report.decision_text import shortened

    notes = [f"{shortened(name, 60)}: {shortened(text, 500)}" for name, text in record.notes.items()]
    return "\n".join(["notes", *(textwrap.fill(note, _WIDTH, subsequent_indent="   ") for note in notes)])
