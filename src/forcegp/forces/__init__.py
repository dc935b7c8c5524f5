"""Priors on unknown forces, and the quantities of a constrained system computed from their posterior."""
