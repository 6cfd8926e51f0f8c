"""The command line, one module or package per command; main.py starts it."""
