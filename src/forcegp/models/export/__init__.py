"""A fitted model as plain C: its numbers, the source text, the folder that is written, the same in Python."""
