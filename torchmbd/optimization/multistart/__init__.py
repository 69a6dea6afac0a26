"""Local searches from many starts."""
