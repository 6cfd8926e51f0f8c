"""Checks of runs that are stopped in the middle of the fit, and of what outlives a run."""

from __future__ import annotations

import signal
from pathlib import Path

from splashbench.harness.conformance.findings import Found, Verdict, found
from splashbench.harness.conformance.model_checks import whole_fit
from splashbench.harness.conformance.stopping import Stopped, ignores_interrupts
from splashbench.harness.conformance.trial import Trial
from splashbench.scene import Scene
from splashbench.submission import Status, Submission, check_submission


def time_limit(trial: Trial) -> Found:
    """A fit that takes longer than it may."""
    stopped, out = trial.stopped(None, _half_way(trial))
    if stopped.exit_code != 1 or not out.is_dir():
        return Verdict.FAILED, f"the run did not end with status timeout: {stopped.said or stopped.exit_code}"
    submission = Submission.open(out, verify=False)
    faults = check_submission(out, Scene.open(trial.ordinary.scene))
    if submission.status != Status.TIMEOUT:
        faults = [f"status {submission.status.value}: {submission.reason}", *faults]
    return found([*faults, *_debris(out)], submission.reason)


def _half_way(trial: Trial) -> int:
    """The number of the progress report in the middle of the fit."""
    return max(1, whole_fit(trial).said.reports // 2)


def signals(trial: Trial) -> Found:
    """A run that a user or a machine stops."""
    # Early and late: a method may start processes and files of its own on the way.
    stops = {signal.SIGTERM: _half_way(trial)} | ({} if ignores_interrupts() else {signal.SIGINT: 1})
    faults = []
    for signum, report in stops.items():
        stopped, out = trial.stopped(signum, report)
        faults += [f"{signum.name}: {fault}" for fault in signal_faults(stopped, signum, out)]
    return found(faults, " and ".join(signum.name for signum in stops))


def signal_faults(stopped: Stopped, signum: signal.Signals, out: Path) -> list[str]:
    """A line for each fault of a run whose submission was to be `out`, and that `signum` stopped."""
    if not stopped.held:
        return [f"the fit did not get to its middle: {stopped.said or 'it said nothing'}"]
    if stopped.exit_code is None:
        return ["the run did not end"]
    faults = [] if stopped.exit_code == 128 + signum else [f"exit status {stopped.exit_code}: {stopped.said}"]
    return faults + (["there is a submission"] if out.exists() else []) + _debris(out)


def _debris(out: Path) -> list[str]:
    return [f"{path.name} was left beside the submission" for path in sorted(out.parent.iterdir()) if path != out]


def processes(trial: Trial) -> Found:
    """Processes that are still there when their run has ended."""
    _ = trial.ran, trial.fitted
    return found(trial.bench.left)
