"""Measures of vibrations: what experiment files and problems ask for."""
