"""Tasks in child processes, several at once: on this machine, or on the machines of a Ray cluster."""
