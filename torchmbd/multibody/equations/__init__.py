"""Topology of a system and its equations of motion: which bodies, joints and forces there are, and what acts on them."""
