"""Priors on unknown forces, and quantities of a constrained system computed from the posterior forces."""
