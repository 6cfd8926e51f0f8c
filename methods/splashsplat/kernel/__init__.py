"""SplashSplat's own compiled kernel: decoder, losses of an image window, and Adam by rows."""
