"""Reference motions and the task-space controller that tracks them."""
