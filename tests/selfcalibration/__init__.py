"""Tests of what a scene's own footage says of its cameras and clocks."""
