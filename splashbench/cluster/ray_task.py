"""What runs in Ray's own processes: the check of a machine, and a piece of work given to a worker beside it.

Ray's processes have threads, and fork nothing. Each keeps one worker (worker.py), which ends with it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

from splashbench.cluster.shared_folder import Shared, fault_here
from splashbench.cluster.work import Ended, Work
from splashbench.cluster.worker_process import WorkerProcess

_worker: WorkerProcess | None = None
_checked: Shared | None = None


def check(asked: Shared, machine: str) -> str:
    """See `fault_here`."""
    return fault_here(asked, machine)


def carry_out(work: Work, modules: Sequence[str], folders: Sequence[str], asked: Shared) -> Ended | str:
    """Carry out `work`; a line for the user where this machine cannot.

    folders: where workers import from. asked: looked at once, since machines may join later.
    """
    global _worker, _checked
    if _checked != asked:
        fault = fault_here(asked, os.uname().nodename)
        if fault:
            return fault
        _checked = asked
    # Ray says which GPUs this piece of work has; work that asked for none sees none.
    given = {"CUDA_VISIBLE_DEVICES": os.environ.get("CUDA_VISIBLE_DEVICES") if work.needs.gpus else ""}
    work = replace(work, environment={**given, **work.environment})
    if _worker is None:
        _worker = WorkerProcess(modules, folders)
    worker = _worker
    worker.start(work)
    try:
        exit_code = worker.answer()
    except BaseException:  # cancelled by the driver
        _worker = None
        worker.stop()
        raise
    if exit_code is None:
        _worker = None
        return Ended(work.key, lost=worker.why_lost())
    return Ended(work.key, exit_code)
