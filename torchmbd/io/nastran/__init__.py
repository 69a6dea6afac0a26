"""Nastran bulk data: cards, meshes, materials, bodies."""
