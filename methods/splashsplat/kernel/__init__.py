"""SplashSplat's compiled kernel: decoder, window losses, Adam by rows, shared features, and the fit of velocities."""
