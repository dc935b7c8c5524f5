"""Export of a fitted model to plain C: its numbers, its source text, the folder that is written, and the
compiled predictor in Python.
"""
