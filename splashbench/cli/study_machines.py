"""Where the runs of a study are made, and what each may take: options that all studies share."""

from __future__ import annotations

import argparse
from typing import Any

from splashbench.cli.arguments import positive_number, whole_number


def add_machines(parser: argparse.ArgumentParser) -> None:
    """Add `--on`, `--jobs`, `--cores`, `--gpus` and `--memory`, as a group of their own."""
    group = parser.add_argument_group(
        "machines", "Without --on runs are made on this machine (docs/study.md, many machines, has a recipe for SLURM)."
    )
    group.add_argument(
        "--on",
        metavar="ray[://HOST:PORT]",
        help="make runs on a Ray cluster, which has to see scenes and OUT at the same place on every machine: the one "
        "that this machine belongs to or, where there is none, this machine; or the one whose head is at HOST:PORT",
    )
    group.add_argument(
        "--jobs",
        type=whole_number(1),
        metavar="N",
        help="runs at the same time (default: 1; with --on as many as there is room for)",
    )
    group.add_argument(
        "--cores",
        type=whole_number(1),
        metavar="N",
        help="threads of each run (default: all of this machine; with --on 1)",
    )
    group.add_argument(
        "--gpus",
        type=whole_number(0),
        metavar="N",
        help="with --on: GPUs of each run whose method uses one (default: 1)",
    )
    group.add_argument(
        "--memory",
        type=positive_number("gigabytes"),
        metavar="GB",
        help="memory of each run; one that takes more is stopped as out of memory (default: no limit)",
    )


def machine_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """What `ExecutionOptions` takes of these options."""
    if arguments.gpus is not None and arguments.on is None:
        arguments.usage_error("--gpus is for --on; on this machine a run has its GPU without it")
    return {
        "on": arguments.on,
        "jobs": arguments.jobs,
        "cores": arguments.cores,
        "gpus": arguments.gpus,
        "memory_bytes": round(1e9 * arguments.memory) if arguments.memory else None,
    }
