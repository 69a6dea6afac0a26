"""Linear algebra of the saddle-point matrix: blocks, factors, rank, condensation, and the multipliers that follow."""
