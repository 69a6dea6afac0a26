"""Applied forces on frames."""
