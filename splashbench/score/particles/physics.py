"""The particle metrics of a submission: sigma_D, mu_D, uniformity index and Delta E, with a reason for every null."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.scene import Particles, Scene
from splashbench.score.image.views import Track
from splashbench.score.mixed import liquid_of_mixed
from splashbench.score.particles.density import DensityStatistics, frame_density
from splashbench.score.particles.energy import energy_deviation
from splashbench.score.particles.uniformity import DistanceFields, frame_uniformity
from splashbench.score.result import MetricValue, frame_mean, metric_value
from splashbench.score.settings import Protocol

PARTICLE_METRICS = ("sigma_d", "mu_d", "uniformity", "delta_e")


def liquid_particles(scene: Scene, submission: Any) -> tuple[Particles | None, str]:
    """The submission's particles that are liquid, on the scene's frames; or None, and why there are none."""
    particles = submission.particles()
    if particles is None:
        return None, "the submission has no particles"
    if particles.n_frames != scene.n_frames:
        return None, f"the particles have {particles.n_frames} instants, the scene {scene.n_frames} frames"
    return (liquid_of_mixed(particles, scene) if submission.identity.mixed else particles), ""


def score_particles(
    scene: Scene,
    particles: Particles | None,
    no_particles: str,
    fields: Callable[[], DistanceFields],
    protocol: Protocol,
    track: Track,
) -> dict[str, MetricValue]:
    """Every particle metric of `particles`, or of None for the reason `no_particles`.

    `fields` is asked only when there are particles.
    """
    if particles is None:
        return {name: metric_value(name, None, no_particles) for name in PARTICLE_METRICS}
    try:
        distance: DistanceFields | None = fields()
        no_distance = ""
    except SplashbenchError as error:
        distance, no_distance = None, str(error)
    values = _density_values(scene, particles, distance, no_distance, protocol, track)
    values["delta_e"] = _energy_value(scene, particles, protocol)
    return values


def _density_values(
    scene: Scene,
    particles: Particles,
    distance: DistanceFields | None,
    no_distance: str,
    protocol: Protocol,
    track: Track,
) -> dict[str, MetricValue]:
    if scene.is_released:
        scale = 1.0
    elif distance is not None:
        scale = protocol.reference_longest_side / distance.longest_side
    else:
        return {
            name: metric_value(name, None, f"no hull to take the scale from: {no_distance}")
            for name in ("sigma_d", "mu_d", "uniformity")
        }
    densities: list[DensityStatistics | None] = []
    uniformity: list[float | None] = []
    for t in track(range(scene.n_frames), "scoring particles"):
        density = frame_density(particles.at(t).astype(np.float64) * scale, t, protocol)
        densities.append(density)
        uniformity.append(
            frame_uniformity(density, distance, t, scale, protocol) if density is not None and distance else None
        )
    too_few = f"no frame has {protocol.neighbours + 1} particles"
    too_thin = no_distance or f"{too_few}, with neighbours within h, and observed liquid thick enough for the grid"
    return {
        "sigma_d": frame_mean("sigma_d", [d.sigma if d else None for d in densities], too_few),
        "mu_d": frame_mean("mu_d", [d.mu if d else None for d in densities], too_few),
        "uniformity": frame_mean("uniformity", uniformity, too_thin),
    }


def _energy_value(scene: Scene, particles: Particles, protocol: Protocol) -> MetricValue:
    unknown = [
        what
        for what, missing in (
            ("gravity's direction", scene.gravity is None),
            ("the metric scale", scene.metres_per_unit is None),
            ("the frames' times", scene.times_source == "nominal"),
        )
        if missing
    ]
    if scene.gravity is None or scene.metres_per_unit is None or unknown:
        return metric_value("delta_e", None, f"the scene does not say {' nor '.join(unknown)} (scene.json)")
    change = energy_deviation(particles, scene.times, -scene.gravity, scene.metres_per_unit, protocol)
    if change is None:
        return metric_value("delta_e", None, "no particle lives through three frames")
    # The first and the last frame have no change by definition; they are not counted as skipped.
    skipped = sum(value is None for value in change.changes[1:-1])
    return metric_value("delta_e", change.value, skipped_frames=skipped, frames=change.changes)
