"""The default: SQCQP for few design variables, SLSQP for many.

SQCQP has second derivatives for each function and learns them along one direction with each simulation. With few variables it
needs fewer simulations than SLSQP (docs/reference/optimization.md). With many it knows few of the directions, and its model
problem takes longer than a simulation.
"""

from __future__ import annotations

from dataclasses import replace

from torchmbd.optimization.methods.slsqp import slsqp
from torchmbd.optimization.methods.sqcqp import sqcqp
from torchmbd.optimization.optimizer import Ending, register
from torchmbd.optimization.search import Search

FEW = 20  # variables; with 50 on a separable problem of closed formulas SQCQP needs 65 simulations, SLSQP 15


@register("auto", dense=True)
def auto(search: Search, max_iterations: int, *, ftol: float = 1e-6, kkt: float = 1e-3) -> Ending:
    """Run SQCQP for at most FEW variables, else SLSQP; the message says which."""
    name, method = ("sqcqp", sqcqp) if search.size <= FEW else ("slsqp", slsqp)
    ending = method(search, max_iterations, ftol=ftol, kkt=kkt)
    return replace(ending, message=f"{name}: {ending.message}" if ending.message else name)
