"""Export of a fitted model to plain C, and the compiled predictor in Python."""
