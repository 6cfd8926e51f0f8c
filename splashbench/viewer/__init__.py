"""The viewer: scenes and submissions in a browser, with control over time (docs/viewer.md). Drawn by viser."""
