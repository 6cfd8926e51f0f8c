"""Models that the official codes of the baselines saved, read without running anything in them."""
