"""The methods of this project, one folder each; installed as `splashbench_methods` (CONTRIBUTING.md)."""
