"""Video and sound files, decoded in a child process within limits of memory and time."""
