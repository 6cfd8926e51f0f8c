"""How the carriers look: features decoded into Gaussians, and their fit to the photographs (paper, "Optimization")."""
