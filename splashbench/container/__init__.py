"""The container's mesh, placed in the scene by its silhouettes or by clicked points, or taken from the footage."""
