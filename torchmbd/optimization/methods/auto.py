"""The default: SQCQP for few design variables, SLSQP for many, and both where SQCQP stalls.

SQCQP has second derivatives for each function and learns them along one direction with each simulation. With few variables it
needs fewer simulations than SLSQP (docs/reference/optimization.md). With many it knows few of the directions, and its model
problem takes longer than a simulation. A function with a kink, such as the larger one of two peaks, has no second derivatives
there, and SQCQP may creep along it. Then SLSQP begins at the start, on another path, and the better end counts. Where designs
fail, SLSQP would stop beside them as well, and is not tried.
Checked in tests/optimization/methods/test_auto.py.
"""

from __future__ import annotations

from dataclasses import replace

from torchmbd.optimization.kkt import SMALLEST_OBJECTIVE
from torchmbd.optimization.methods.slsqp import slsqp
from torchmbd.optimization.methods.sqcqp import sqcqp
from torchmbd.optimization.optimizer import Ending, register
from torchmbd.optimization.search import Search

FEW = 20  # variables; with 50 on a separable problem of closed formulas SQCQP needs 65 simulations, SLSQP 15
EQUAL = 1e-6  # of the objective: of two ends that differ by less the second counts, which may have converged


@register("auto", dense=True)
def auto(search: Search, max_iterations: int, *, ftol: float = 1e-6, kkt: float = 1e-3) -> Ending:
    """Run SQCQP for at most FEW variables, and SLSQP for more and after SQCQP has stalled; the message says which."""
    if search.size > FEW:
        return _named("slsqp", slsqp(search, max_iterations, ftol=ftol, kkt=kkt))
    first = _named("sqcqp", sqcqp(search, max_iterations, ftol=ftol, kkt=kkt))
    remaining = max_iterations - (len(search.history) - 1)
    if first.status != "stalled" or search.failures or remaining <= 0:
        return first
    second = _named("slsqp", slsqp(search, remaining, ftol=ftol, kkt=kkt))
    reached, other = search.evaluate(first.y), search.evaluate(second.y)
    margin = EQUAL * max(abs(reached.objective), SMALLEST_OBJECTIVE)
    if search.rank(replace(reached, objective=reached.objective + margin)) < search.rank(other):
        return replace(first, message=f"{first.message}; nothing better by {second.message}")
    return replace(second, message=f"{second.message}, after {first.message}")


def _named(name: str, ending: Ending) -> Ending:
    return replace(ending, message=f"{name}: {ending.message}" if ending.message else name)
