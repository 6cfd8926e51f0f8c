"""Data alone: measured and reported figures; splashbench/paper_figures.py reads the reported ones."""
