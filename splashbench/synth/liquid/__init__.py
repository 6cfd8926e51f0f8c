"""The simulated liquid: SPH simulation, its surface and its trajectories."""
