"""Ordinary parts: each a script of a few lines, and the same question as an experiment file beside it.

    python experiments/models/parts/tube_arm.py
    torchmbd run experiments/models/parts/tube_arm.yaml

docs/validation/parts.md lists them with their optima. Checked in tests/experiments/test_parts.py.
"""
