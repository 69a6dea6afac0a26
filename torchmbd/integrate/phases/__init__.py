"""Motions through phases: locks, releases, events and impacts, and their adjoint."""
