"""Synthetic recordings and scenes with exact ground truth, and the verification of scenes prepared from them."""
