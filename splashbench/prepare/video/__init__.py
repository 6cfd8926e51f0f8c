"""Recordings frame by frame: reading them, when something moves in them, which frames a scene takes."""
