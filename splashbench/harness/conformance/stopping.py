"""Checks of runs that are stopped in the middle of the fit, and of what outlives a run.

The run is a process of its own, of a method that pauses: `PausedMethod` in this file, given to `run` as FILE.py:CLASS.
Environment variables tell it which method to fit, at which report of progress to pause (from 1; at the end of the fit
where there are fewer), and which file to write then.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import signal
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splashbench.child import tool_command
from splashbench.harness.conformance.evidence import SEED, Evidence, complete_fit
from splashbench.harness.conformance.report import Judgement, Verdict, check, judge
from splashbench.harness.contract import Fitted, Method, Run
from splashbench.harness.discovery import load_method
from splashbench.processes import ends_within, has_ended
from splashbench.progress import Bar
from splashbench.scene import Scene, TrainingScene
from splashbench.submission import Status, Submission, check_submission

_POLL_SECONDS = 0.05
#: Allowed to a process for starting, on top of half a fit, before its time limit is up.
_STARTING_SECONDS = 3.0
#: Until a run that was asked to stop has cleaned up; until killed processes are gone.
_PATIENCE_SECONDS = 20.0
_KILLED_SECONDS = 3.0
_STAY = "write nothing beside the folders that the harness gives, and leave signals and process groups as they are"
_METHOD, _REPORT, _FLAG = (f"SPLASHBENCH_PAUSED_{name}" for name in ("METHOD", "REPORT", "FLAG"))


@dataclass
class StoppedRun:
    """How a run ended that was stopped.

    Attributes:
        paused: whether the fit was under way and paused when it ended.
        exit_code: of the run, negative for a signal; None where it did not end when it was asked to.
        last_line: on standard error.
        alive: a line for each of its processes that lived on then, with what the kernel says that it did.
    """

    paused: bool
    exit_code: int | None
    last_line: str
    alive: list[str] = field(default_factory=list)


@check("a fit that takes too long is stopped, with status timeout and nothing half-written", _STAY)
def time_limit(evidence: Evidence) -> Judgement:
    stopped, out = _stopped_run(evidence, None, _half_way(evidence))
    if stopped.exit_code != 1 or not out.is_dir():
        return Verdict.FAILED, f"the run did not end with status timeout: {stopped.last_line or stopped.exit_code}"
    submission = Submission.open(out, verify=False)
    faults = check_submission(out, Scene.open(evidence.ordinary.scene))
    if submission.status != Status.TIMEOUT:
        faults = [f"status {submission.status.value}: {submission.reason}", *faults]
    return judge([*faults, *_debris(out)], submission.reason)


@check("stopped by SIGTERM or Ctrl-C in the middle of the fit, a run leaves nothing half-written", _STAY)
def signals(evidence: Evidence) -> Judgement:
    # Early and late: a method may start processes and files of its own on the way.
    stops = {signal.SIGTERM: _half_way(evidence)}
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in the background of a script, and inherited
        stops[signal.SIGINT] = 1
    faults = []
    for signum, report in stops.items():
        stopped, out = _stopped_run(evidence, signum, report)
        faults += [f"{signum.name}: {fault}" for fault in signal_faults(stopped, signum, out)]
    return judge(faults, " and ".join(signum.name for signum in stops))


def _half_way(evidence: Evidence) -> int:
    """The number of the progress report in the middle of the fit."""
    return max(1, complete_fit(evidence).progress.reports // 2)


def signal_faults(stopped: StoppedRun, signum: signal.Signals, out: Path) -> list[str]:
    """A line for each fault of a run whose submission was to be `out`, and that `signum` stopped."""
    if not stopped.paused:
        return [f"the fit did not get to its middle: {stopped.last_line or 'it said nothing'}"]
    if stopped.exit_code is None:
        alive = f" ({', '.join(stopped.alive)})" if stopped.alive else ""
        return [f"the run did not end within {_PATIENCE_SECONDS:g} s{alive}: {stopped.last_line or 'it said nothing'}"]
    faults = [] if stopped.exit_code == 128 + signum else [f"exit status {stopped.exit_code}: {stopped.last_line}"]
    return faults + (["there is a submission"] if out.exists() else []) + _debris(out)


def _debris(out: Path) -> list[str]:
    return [f"{path.name} was left beside the submission" for path in sorted(out.parent.iterdir()) if path != out]


@check(
    "no process outlives its run",
    "start processes in the method's own process group (no start_new_session, no daemons) and end them",
)
def processes(evidence: Evidence) -> Judgement:
    _ = evidence.run, evidence.fitted
    return judge(evidence.bench.left)


def _stopped_run(evidence: Evidence, signum: signal.Signals | None, report: int) -> tuple[StoppedRun, Path]:
    """A run paused at its progress report number `report` and stopped by `signum`, or by its time limit where None.

    Returns also the place of its submission.
    """
    name = signum.name if signum else "timeout"
    work = evidence.bench.folder(f"stopped_{name}")
    out = evidence.bench.folder(f"stopped_{name}/out") / "submission"
    arguments = [str(evidence.ordinary.scene), str(out), "--preset", evidence.preset, "--seed", str(SEED)]
    arguments += ["--device", evidence.device, "--timing-frames", "0"]
    for pair in as_pairs(evidence.overrides):
        arguments += ["--set", pair]
    limit = evidence.timeout_seconds
    if signum is None:
        limit = round(_STARTING_SECONDS + evidence.fitted.fit_seconds / 2, 1)
        arguments += ["--timeout", f"{limit:g}"]
    environment = {_METHOD: evidence.name, _REPORT: str(report), _FLAG: str(work / "paused")}
    with evidence.bench.process(f"the run stopped by {name}"):
        bar = Bar(f"{evidence.method.id}: stopped by {name}", keep=False)
        try:
            return _stop(arguments, environment, signum, limit, work / "log", bar), out
        finally:
            bar.close()


def _stop(
    arguments: list[str],
    environment: dict[str, str],
    signum: signal.Signals | None,
    limit_seconds: float,
    log: Path,
    bar: Bar,
) -> StoppedRun:
    """`splashbench run PausedMethod ARGUMENTS`, sent `signum` when it has paused.

    Without a signal it is left to the limit among its arguments. limit_seconds: for getting to the pause.
    """
    flag = Path(environment[_FLAG])
    command = tool_command("run", f"{__file__}:PausedMethod", *arguments)
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
            start_new_session=True,
        )
    start = time.monotonic()
    try:
        while not has_ended(process) and not flag.exists() and time.monotonic() - start < limit_seconds:
            time.sleep(_POLL_SECONDS)
            bar.update((time.monotonic() - start) / limit_seconds, "until the middle of the fit")
        paused = flag.exists()
        if signum is not None and not has_ended(process):
            process.send_signal(signum)
        # With a limit of its own, the rest of that limit is still to come.
        patience = _PATIENCE_SECONDS if signum is not None else limit_seconds + _PATIENCE_SECONDS
        alive = [] if ends_within(process, patience) else _alive(process.pid)
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
        last_line = next((line for line in reversed(lines) if line.strip()), "")
        return StoppedRun(paused or flag.exists(), process.poll(), last_line[:300], alive)
    finally:
        if not has_ended(process):  # it does not stop, or the user interrupts the test
            process.send_signal(signal.SIGTERM)
            ends_within(process, _KILLED_SECONDS)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _alive(process: int) -> list[str]:
    """A line for `process` and each below it."""
    import psutil

    lines = []
    with contextlib.suppress(psutil.Error):
        for each in (root := psutil.Process(process), *root.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                lines.append(f"{each.name()} {each.pid} {each.status()}")
    return lines


def as_pairs(overrides: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Settings as `--set` takes them: `{"a": {"b": 1}}` -> `["a.b=1"]`."""
    pairs = []
    for key, value in overrides.items():
        if isinstance(value, Mapping):
            pairs += as_pairs(value, f"{prefix}{key}.")
        else:
            pairs.append(f"{prefix}{key}={json.dumps(value)}")
    return pairs


def __getattr__(name: str) -> type[Method]:
    if name != "PausedMethod":
        raise AttributeError(name)
    return _paused_method(os.environ[_METHOD])


@functools.cache
def _paused_method(name: str) -> type[Method]:
    method = type(load_method(name))

    class PausedMethod(method):  # type: ignore[valid-type, misc]
        def fit(self, scene: TrainingScene, config: Any, run: Run) -> Fitted:
            report, left = run._report, int(os.environ[_REPORT])

            def reporting(fraction: float, message: str) -> None:
                nonlocal left
                if report is not None:
                    report(fraction, message)
                left -= 1
                if left <= 0:
                    _pause()

            run._report = reporting
            super().fit(scene, config, run)
            _pause()
            raise AssertionError

    return PausedMethod


def _pause() -> None:
    Path(os.environ[_FLAG]).write_text("paused", encoding="ascii")
    while True:
        time.sleep(1)
