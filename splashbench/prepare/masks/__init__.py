"""Liquid masks: where they come from, and how two sets of them compare."""
