"""What stands still: every training view without its liquid (plate.py), and how deep its pixels lie (sweep.py view by
view, depth.py across views). Needs no torch."""
