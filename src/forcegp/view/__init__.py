"""3D view of a robot, its surfaces, contact forces and predicted paths in the browser."""
