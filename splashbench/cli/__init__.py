"""The command line, one module per command (splashbench/cli/main.py)."""
