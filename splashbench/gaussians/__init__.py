"""3D Gaussian splatting as the baselines share it: primitives, density control, the fit, and the liquid among them.

A library, not a method: deformable_3dgs, spacetime_gaussians, scaffold_4d and scaffold_gs build on it (Kerbl et al.,
SIGGRAPH 2023, and the sections that each module names).
"""
