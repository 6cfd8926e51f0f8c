"""Data alone: the 20 real scenes as tables; splashbench/manifest.py reads them, README.md names their sources."""
