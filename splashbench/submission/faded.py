"""The control `faded`: what a method shows at the timesteps it saw, cross-faded to those it did not see.

At a withheld timestep its render is the mean of the method's own renders of the timesteps before and after, colour and
opacity alike, weighted by nearness in time. Without it a table cannot show that a method's motion adds anything. It
needs no fit and no model: the renders lie in the submission, so a code in an environment of its own has it as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.errors import SplashbenchError
from splashbench.scene import Scene
from splashbench.submission.identity import Record
from splashbench.submission.submission import Submission
from splashbench.submission.withheld import scored_timesteps, seen_around

#: Behind the method's name in identities and tables.
FADED = "_faded"


class FadedSubmission:
    """`submission`, its renders of withheld timesteps replaced; scored as a control named METHOD_faded.

    Raises SplashbenchError where no timesteps were withheld. Costs are null: they are the method's own.
    """

    def __init__(self, submission: Submission, scene: Scene) -> None:
        identity = submission.identity
        if identity.withheld is None:
            raise SplashbenchError(f"{submission.directory} has no withheld timesteps, between which it could fade")
        self._submission, self._scene = submission, scene
        self._faded = frozenset(scored_timesteps(scene.n_frames, identity.withheld))
        self.directory, self.digest = submission.directory, submission.digest
        self.identity = identity.model_copy(update={"method": f"{identity.method}{FADED}", "control": True})
        self.status, self.reason = submission.status, submission.reason
        self.record = Record(status=self.status, reason=self.reason)

    def rendering(self, camera: str, t: int) -> NDArray[np.uint8]:
        """sRGB uint8 [H, W, 3] of test view `camera` at timestep `t`."""
        if t not in self._faded:
            return self._submission.rendering(camera, t)
        around, share = self._around(camera, t)
        before, after = (self._submission.rendering(camera, seen).astype(np.float64) for seen in around)
        return np.round((1 - share) * before + share * after).astype(np.uint8)

    def alpha(self, camera: str, t: int) -> NDArray[np.float32]:
        """Foreground opacity [H, W] in [0, 1] of test view `camera` at timestep `t`."""
        if t not in self._faded:
            return self._submission.alpha(camera, t)
        around, share = self._around(camera, t)
        before, after = (self._submission.alpha(camera, seen) for seen in around)
        return np.asarray((1 - np.float32(share)) * before + np.float32(share) * after, dtype=np.float32)

    def particles(self) -> None:
        """None: where timesteps are withheld there are none to compare."""

    def geometry(self) -> None:
        """None, as `particles`."""

    def _around(self, camera: str, t: int) -> tuple[tuple[int, int], float]:
        """The timesteps before and after `t` that the method saw; and how far `t` is on its way from one to the other
        by the camera's clock, in (0, 1)."""
        before, after = seen_around(t, self._scene.n_frames, self.identity.withheld)
        assert before is not None  # `t` is one that is scored
        assert after is not None
        times = self._scene.camera_times[camera]
        return (before, after), float((times[t] - times[before]) / (times[after] - times[before]))
