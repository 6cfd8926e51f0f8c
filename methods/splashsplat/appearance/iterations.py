"""How many iterations a fit had, as a decision with its evidence."""

from __future__ import annotations

from collections.abc import Sequence

from splashbench.harness.contract import MAX_RUNGS, Decision, Rung

from .schedule import Earned


def iterations_decision(earned: Sequence[Earned], iterations: int) -> Decision:
    """What stretches of iterations bought (`EarningSchedule`), and how many there were in the end."""
    last = earned[-1]
    ended = (
        "the limit was reached first" if last.pays else f"those up to {last.iterations[1]} gained {last.gain:+.2f} dB"
    )
    shown = [*earned[: MAX_RUNGS - 1], last] if len(earned) > MAX_RUNGS else earned
    return Decision(
        name="iterations",
        basis="withheld",
        chosen=f"{iterations} iterations",
        because=f"there are more as long as withheld photographs gain more than the time is worth; {ended}",
        measure="PSNR of withheld photographs, dB",
        rungs=[
            Rung(
                value=f"{stretch.iterations[1]} iterations",
                bought=stretch.pays,
                quality=stretch.quality,
                gain=stretch.gain,
                standard_error=stretch.standard_error,
                reason=f"{stretch.price:.3f} dB would be worth it",
            )
            for stretch in shown
        ],
    )
