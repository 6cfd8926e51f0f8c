"""Restyle: the reconstructed liquid with another dye; its shape, what lies behind it and the container stay."""

from splashbench.restyle.filmed_dye import FilmedDye, filmed_dye
from splashbench.restyle.relighting import Buffers, Restyled, restyled

__all__ = ["Buffers", "FilmedDye", "Restyled", "filmed_dye", "restyled"]
