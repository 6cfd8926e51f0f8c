"""Yardsticks that reconstruct no liquid: every score has to be read beside theirs."""
