"""Discrete variables: branch and bound over allowed values."""
