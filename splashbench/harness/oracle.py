"""The control `oracle`: the ground truth itself as a submission, written by the harness and marked as a control.

No method sees a test image, so this is no method. It must score the perfect value on every image metric; where the
scene has true particles they are handed in with the liquid they stand for, and score the perfect value against the
truth; else the particle metrics are null.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from splashbench.files import atomic_directory, write_model
from splashbench.harness import hardware
from splashbench.progress import track
from splashbench.scene import Scene, SignedDistance
from splashbench.submission import IDENTITY, Identity, Record, Submission, seal, write_view
from splashbench.submission.cameras import CAMERAS, scene_views
from splashbench.submission.scene_files import write_scene_files
from splashbench.version import __version__


def write_oracle(
    scene: Scene,
    out: Path,
    *,
    geometry: Callable[[Scene], SignedDistance | None] | None = None,
    replace: bool = False,
) -> Submission:
    """Write the oracle's submission for `scene` into `out`.

    geometry: gives the true liquid of a scene with true particles (score.truth.comparison.oracle_geometry); without it
    no signed distance is handed in.
    """
    with atomic_directory(out, replace=replace, holds=IDENTITY, inputs=[scene.directory]) as staging:
        for t in track(range(scene.n_frames), "oracle"):
            for name in scene.test:
                mask = np.where(scene.mask(name, t), 255, 0).astype(np.uint8)
                write_view(staging, name, t, scene.image(name, t), mask)
        particles = scene.truth_particles()
        if particles is not None:
            particles.save(staging / "particles.npz")
            signed_distance = geometry(scene) if geometry is not None else None
            if signed_distance is not None:
                signed_distance.save(staging / "geometry.npz")
        identity = Identity(
            method="oracle",
            preset="truth",
            scene=scene.name,
            scene_digest=scene.digest,
            told=scene.stated,
            control=True,
            splashbench_version=__version__,
            hardware=hardware.describe(),
        )
        count = float(particles.active.sum(axis=1).mean()) if particles is not None else None
        write_model(staging / CAMERAS, scene_views(scene))
        write_scene_files(staging, scene)
        seal(staging, identity, Record(particles_per_frame=count))
    return Submission.open(out)
