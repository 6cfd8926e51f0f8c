"""The check of what a fit costs where its user says how much it may."""

from __future__ import annotations

from splashbench.harness.conformance.evidence import Evidence, OrdinaryRun
from splashbench.harness.conformance.report import Judgement, NotTested, Verdict, check, judge
from splashbench.submission import Budget

#: Told apart by name: a method's `budgets` may have no others.
_LIMITS = tuple(Budget.model_fields)


@check(
    "budgets that the method says it keeps to are kept, within 5 %",
    "go by run.budget, as nearly as it can be kept, or leave out of `budgets` what the method does not keep to",
)
def budgets(evidence: Evidence) -> Judgement:
    named = evidence.method.budgets
    if not named:
        return Verdict.OK, "it takes none"
    unknown = [name for name in named if name not in _LIMITS]
    if unknown:
        return Verdict.FAILED, f"budgets names {unknown[0]!r}; there are {', '.join(_LIMITS)}"
    if not evidence.run.ok:
        raise NotTested(f"the run without them ended as {evidence.run.status}")
    limits = evidence.budget.limits
    untried = [name for name in named if name not in limits]
    told = f"not tried: {', '.join(untried)}" if untried else ""
    if not limits:
        return Verdict.OK, told
    run = evidence.budgeted
    if _faults(run, evidence.budget):
        run = evidence.budgeted_again
    return judge(_faults(run, evidence.budget), "; ".join(filter(None, [_used(run, evidence.budget), told])))


def _faults(run: OrdinaryRun, budget: Budget) -> list[str]:
    if run.record is None or not run.ok:
        return [f"{run.status}: {run.reason}"]
    return budget.exceeded(run.record.fit_seconds, run.record.storage_bytes, run.record.peak_memory_bytes)


def _used(run: OrdinaryRun, budget: Budget) -> str:
    """What of `budget` was used, in words."""
    assert run.record is not None
    used = []
    if budget.seconds is not None:
        used.append(f"{run.fit_seconds:.1f} of {budget.seconds:.1f} s")
    if budget.storage_bytes is not None:
        used.append(f"{(run.record.storage_bytes or 0) / 1e6:.3f} of {budget.storage_bytes / 1e6:.3f} MB")
    return ", ".join(used)
