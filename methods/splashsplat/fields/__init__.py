"""Observation fields: signed distance, pool and jet, frame by frame (paper, "Observation fields")."""
