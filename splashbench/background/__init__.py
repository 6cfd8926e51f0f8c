"""The static background: each training view's clean plate (its image without liquid), and the depth of its pixels."""
