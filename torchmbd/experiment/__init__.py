"""Experiments: a file in, a tracked study out."""
