"""What is stored of a fitted liquid: whole numbers in steps that rendering cannot tell apart, entropy-coded.

FORMAT.md describes the files for readers of other programs.
"""
