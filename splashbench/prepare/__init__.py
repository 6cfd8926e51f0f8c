"""Session to Scene: a raw recording becomes calibrated, synchronised, masked frames; a file per step."""
