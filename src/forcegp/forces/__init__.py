"""Priors on unknown forces, and every quantity of a constrained system read off their posterior."""
