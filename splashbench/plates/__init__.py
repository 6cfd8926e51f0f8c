"""What stands still: every training view without its liquid (plate.py), and how deep its pixels lie (sweep.py on a
view's own, depth.py for all). Needs no torch."""
