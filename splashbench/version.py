"""The version of splashbench, in one place: the package metadata, `--version` and every result read it here."""

__version__ = "0.2.0"
