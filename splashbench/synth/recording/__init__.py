"""A synthetic session: what seven cameras and a handheld sweep would have recorded, with exact truth."""
