"""Carriers through forecast, correct, resample (paper, "Forecast, Correct, Resample")."""
