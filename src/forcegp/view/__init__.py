"""3D view in the browser, showing a robot, its surfaces, contact forces and predicted paths."""
