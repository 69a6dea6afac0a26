"""Optimization of flexible multibody systems made of composite materials, with exact gradients."""
