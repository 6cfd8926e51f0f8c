"""The liquid's surface from its particles: marching cubes on the SPH colour field, smoothed (Löschner et al. 2023)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.synth.imaging.geometry import Mesh

# In multiples of the particle radius. Measured on the default pour, the surface encloses 0.92 (spray) to 1.04 (pool)
# times the particles' volume; shorter kernels show the emitter's layers as rings around the stream.
SMOOTHING_LENGTH = 2.0
CUBE_SIZE = 1.2
THRESHOLD = 0.6
SMOOTHING_STEPS = 15


def liquid_surface(positions: NDArray[np.float32], particle_radius: float) -> Mesh | None:
    """The surface around particles at `positions` [N, 3], or None where there are none."""
    import pysplashsurf

    if not len(positions):
        return None
    reconstruction, _ = pysplashsurf.reconstruction_pipeline(
        np.ascontiguousarray(positions, np.float64),
        particle_radius=particle_radius,
        smoothing_length=SMOOTHING_LENGTH,
        cube_size=CUBE_SIZE,
        iso_surface_threshold=THRESHOLD,
        compute_normals=True,
        mesh_smoothing_iters=SMOOTHING_STEPS,
        mesh_cleanup=True,
        multi_threading=False,  # the renderer's workers fill the machine already
    )
    return Mesh(
        vertices=np.asarray(reconstruction.mesh.vertices, np.float32),
        faces=np.asarray(reconstruction.mesh.triangles).astype(np.int32),
        normals=np.asarray(reconstruction.point_attributes["normals"], np.float32),
    )
