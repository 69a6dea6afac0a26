"""Arithmetic without mechanics: value-tangent pairs, time jets, rotations, sparse matrices, generated code."""
