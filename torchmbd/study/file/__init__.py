"""Experiment files: YAML to a checked study, or to one error with all faults and their lines (load.py begins)."""
