"""Plots over time: what `plot` of data sets, predictions, models and rollouts draws with matplotlib."""
