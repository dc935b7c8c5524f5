"""A robot, its surfaces, contact forces and predicted paths in three dimensions, in the browser."""
