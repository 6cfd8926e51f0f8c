"""Images of a synthetic capture: room, light, glass and liquid, by ray casting."""
