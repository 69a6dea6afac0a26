"""Models of the paper and measurements."""
