"""Gaussian-process priors on unknown forces."""
