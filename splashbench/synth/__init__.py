"""Made-up recordings and scenes with exact ground truth, and what a preparation made of them."""
