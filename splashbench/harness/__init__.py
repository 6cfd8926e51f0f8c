"""The method contract, discovery of methods, and the harness that runs and measures them in child processes."""
