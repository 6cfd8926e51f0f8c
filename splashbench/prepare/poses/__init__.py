"""Where the cameras stand, in metres and upright."""
