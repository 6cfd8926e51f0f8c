"""What moves the liquid between two frames: velocity, free fall and the gate on both (paper, "Observed motion")."""
