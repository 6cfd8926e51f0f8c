"""Tests of the viewer, which share an exhibit that is made up, and stand-ins for viser's scene and server."""
