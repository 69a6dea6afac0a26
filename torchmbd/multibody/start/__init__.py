"""Start of a motion: joints closed, velocities compatible, modal coordinates of each design."""
