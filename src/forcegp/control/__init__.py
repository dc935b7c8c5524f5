"""Motions to follow and the task-space controller that follows them."""
