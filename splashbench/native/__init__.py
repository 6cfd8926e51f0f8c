"""What every compiled kernel shares: its C++ helpers, and the Python side that loads libraries and counts threads."""
