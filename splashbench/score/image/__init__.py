"""Image metrics: PSNR, SSIM, LPIPS, silhouettes, jitter (docs/protocol.md)."""
