"""Static equilibrium and steady rotation of a system, and small vibrations about them."""
