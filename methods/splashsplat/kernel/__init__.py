"""SplashSplat's own compiled kernel: decoder, losses of an image window, Adam by rows, and the fit of velocities."""
