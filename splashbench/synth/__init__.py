"""Made-up recordings and scenes with exact ground truth: simulation, filming, sound, and what a preparation got right."""
