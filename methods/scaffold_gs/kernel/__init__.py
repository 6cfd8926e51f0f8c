"""The compiled decoder of static anchors."""
