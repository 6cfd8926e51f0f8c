"""The check of what a fit costs where its user says how much it may."""

from __future__ import annotations

from splashbench.harness.conformance.evidence import Evidence, OrdinaryRun
from splashbench.harness.conformance.report import Judgement, NotTested, Verdict, check, judge
from splashbench.submission import Budget

#: What a method's `budgets` may name.
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
    faults, used = _judged(evidence.budgeted, evidence.budget)
    if faults:
        faults, used = _judged(evidence.budgeted_again, evidence.budget)
    return judge(faults, "; ".join([*used, *([told] if told else [])]))


def _judged(run: OrdinaryRun, budget: Budget) -> tuple[list[str], list[str]]:
    """A line for each fault of `run`, and what of `budget` it used, in words."""
    if run.record is None or not run.ok:
        return [f"{run.status}: {run.reason}"], []
    seconds, storage = run.record.fit_seconds, run.record.storage_bytes
    faults, used = budget.exceeded(seconds, storage, None), []
    for limit, found, unit, form in (
        (budget.seconds, seconds, "s", ".1f"),
        (budget.storage_bytes, storage, "MB", ".3f"),
    ):
        if limit is None:
            continue
        if found is None:
            faults.append(f"the run with a budget has no figure in {unit}")
            continue
        scale = 1e6 if unit == "MB" else 1.0
        used.append(f"{found / scale:{form}} of {limit / scale:{form}} {unit}")
    return faults, used
