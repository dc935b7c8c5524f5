"""3D view in the browser that shows a robot, its surfaces, contact forces and predicted paths."""
