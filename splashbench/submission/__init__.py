"""Submissions: what a method hands in. Writing, reading and checking them."""

from splashbench.submission.budget import Budget
from splashbench.submission.decisions import Decision, Rung
from splashbench.submission.identity import (
    PROTOCOL,
    RENAMED_FIGURES,
    Checkpoint,
    Identity,
    Record,
    Status,
    with_current_names,
)
from splashbench.submission.submission import (
    IDENTITY,
    Submission,
    check_submission,
    identity_text,
    seal,
    to_8bit,
    write_view,
)

__all__ = [
    "IDENTITY",
    "PROTOCOL",
    "RENAMED_FIGURES",
    "Budget",
    "Checkpoint",
    "Decision",
    "Identity",
    "Record",
    "Rung",
    "Status",
    "Submission",
    "check_submission",
    "identity_text",
    "seal",
    "to_8bit",
    "with_current_names",
    "write_view",
]
