"""Finite elements: materials, meshes, elements, sections, and reduction to modes. Knows no motion."""
