"""Optimization methods, each one file and one line in torchmbd.optimization."""
