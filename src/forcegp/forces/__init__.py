"""Priors on unknown forces, and every quantity of a constrained system, computed from their posterior."""
