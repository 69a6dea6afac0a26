"""Bodies, joints and forces, and the system that they make."""
