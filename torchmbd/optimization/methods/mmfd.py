"""The modified method of feasible directions.

Each iteration
1. finds the active (c >= CT) and violated (c > CTMIN) constraints, measured as distances where they are steep;
2. finds a usable-feasible direction, along the active constraints, out of the violated ones (direction.py);
3. searches along it by polynomials, the side constraints by projection, back to curved ones (line_search.py);
4. stops if the objective changed by less than DELOBJ (relative) or DABOBJ (absolute, in units of the start's objective)
   in ITRMOP consecutive iterations, or would not change by more; it has converged if that is a Kuhn-Tucker point.

From a feasible design only designs are accepted that violate no constraint by more than the slack. The slack is CTMIN in
the first iterations and shrinks with the promised gain down to the problem's feasibility tolerance. An infeasible start
becomes feasible first, with the weight Phi on the violation. A failed evaluation shortens the step. Saddle points are left:
the end must be a minimum, not only a Kuhn-Tucker point (curvature.py).

Options have the names of DOT. Differences from DOT: the metric of a direction is updated by every step (metric.py), all
constraints are linearized and not only the active ones, an exact penalty decides in the line search, the tolerances are
tighter (DOT: DELOBJ 1e-3, CTMIN 3e-3 at the end also) and the first step is longer (DOT: DOBJ1 0.1).

Source: Vanderplaats, An efficient feasible directions algorithm for design synthesis, AIAA J. 22 (1984) 1633-1640;
Vanderplaats, Numerical Optimization Techniques for Engineering Design; DOT user's manual (options and criteria). Own
text throughout. Checked in tests/contracts/test_optimizers.py and tests/optimization/test_counts.py.
"""

from __future__ import annotations

from torchmbd.errors import true_or_false
from torchmbd.optimization.methods.feasible_directions import FeasibleDirections, Settings
from torchmbd.optimization.optimizer import Ending, register, require_count, require_range
from torchmbd.optimization.search import Search


@register("mmfd")
def mmfd(
    search: Search,
    max_iterations: int,
    *,
    ct: float = -0.03,
    ctmin: float = 0.003,
    delobj: float = 1e-6,
    dabobj: float = 1e-8,
    itrmop: int = 2,
    dobj1: float = 0.5,
    dx1: float = 1.0,
    kkt: float = 1e-3,
    second_order: bool = True,
) -> Ending:
    """Run the method on one start.

    `dobj1`, `dx1`: share of objective and variables that the first step may change. `kkt`: Kuhn-Tucker residual of an
    optimum. `second_order`: leave saddle points;
    the check takes one analysis for each direction along the active constraints, in one batch.
    """
    require_range("ct", ct, -1.0, 0.0)
    positive = {"ctmin": ctmin, "delobj": delobj, "dabobj": dabobj, "dobj1": dobj1, "dx1": dx1, "kkt": kkt}
    for name, value in positive.items():
        require_range(name, value, 1e-16, 1e3)
    require_count("itrmop", itrmop, 1, 1000)
    second_order = true_or_false("second_order", second_order)
    search.refuse_equalities("mmfd")
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    settings = Settings(ct, ctmin, delobj, dabobj, itrmop, dobj1, dx1, kkt, second_order)
    return FeasibleDirections(search, settings, first).run(max_iterations)
