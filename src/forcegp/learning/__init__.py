"""Learning of force models from logs, as a regression with few kinds of unknowns."""
