"""A fitted model as plain C: its numbers, the source text, the written folder, and the compiled predictor in
Python.
"""
