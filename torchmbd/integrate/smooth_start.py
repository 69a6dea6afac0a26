"""States from which steps of a size go on without transients: at the start, after switches, and where their size changes.

One-step methods keep the constraints at positions, not at rates. Along a smooth motion with the jerk v'' the accelerations of
the method and the rates of the step are

    a = v' + D h v''        D = am - af
    v + h^2 d               d = (1/6 - D/2 - beta) v'' + om x om' / 12

so that q1 = q0 o exp(h v + h^2/2 v' + h^3 (D/2 + beta) v'') is the position at the end of the step: what the weights leave of
h^3/6 v'', and the third term of the motion on the Lie group, which turns have. Steps that begin with a = v' and with rates that
keep the constraints excite a mode of the multipliers with the factor of infinite frequency, about -0.9, three times over: an
error of order h that changes its sign in every step and grows for some, while coordinates stay of order h^2.

Only the shares along M^-1 Phi_q' are needed, so the jerk is that of the constraints alone:

    M v'' + Phi_q' mu = 0,   Phi_q (v'' - om x om') = 6/h^3 (Phi + h Phi' + h^2/2 Phi'' - Phi(q_h)) - 3/h Phi_q(q_h) v'
    d = (1/6 - D/2 - beta) v'' + e,   M e + Phi_q' nu = 0,   Phi_q e = Phi_q (om x om') / 12

with q_h = q o exp(h v) at t + h. No force enters, and it is linear in v': vibrations that the steps do not resolve, with
h^2 v' beyond all lengths, get no large jerk.
What a step itself leaves stays: of order h^2 in all numbers.
Source: Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202 (a at the start); Arnold, Bruels, Cardona, Numer. Math. 129
(2015) 149-179 (order of the multipliers, rates at the start).
Checked in tests/integrate/test_smooth_start.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from torchmbd.integrate.lanes import pick_lanes
from torchmbd.integrate.step import Weights
from torchmbd.math.elementwise import reciprocal
from torchmbd.math.pair import Pair, cat, cross
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import Placement
from torchmbd.multibody.equations.times_as_lanes import at_own_times, at_time
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.system.dynamics import Dynamics, SaddleSolver
from torchmbd.results.state import State


class SmoothStart(NamedTuple):
    """How states of lanes differ between steps of different sizes; of methods without this difference all is zero.

    jerk    along M^-1 Phi_q' [n_v, ...];  offset: d [n_v, ...];  lag: D
    """

    jerk: Any = 0.0
    offset: Any = 0.0
    lag: float = 0.0

    def resized(self, x: State, h: Any, before: Any = 0.0) -> State:
        """States from which steps of sizes h [1 + n, lanes] go on.

        before   size of the steps that led to x; zero: its rates keep the constraints, and a = v'
        """
        if isinstance(self.jerk, float):
            return x
        v = x.v + (h * h - before * before) * self.offset
        return x._replace(v=v, a=x.a + (self.lag * (h - before)) * self.jerk)

    def map(self, f: Callable[[Any], Any]) -> SmoothStart:
        """The same with f of jerk and offset, where there are any."""
        if isinstance(self.jerk, float):
            return self
        return self._replace(jerk=f(self.jerk), offset=f(self.offset))

    def lanes(self, lanes: Sequence[int]) -> SmoothStart:
        """Return the part of some lanes."""
        return self.map(lambda y: pick_lanes(y, lanes))


def smooth_start(
    dynamics: Dynamics,
    weights: Weights,
    x: State,
    t: Any,
    h: Any,
    closed: bool = False,
    solver: SaddleSolver | None = None,
    known: Tensor | None = None,
) -> SmoothStart:
    """Return the smooth start near states x of a system that is not condensed, at times t [1 + n, lanes].

    weights   of a step of size one
    h         sizes of regular steps [1 + n, lanes], over which the third rates are found from positions
    closed    x solves the constraints with their rates and has the accelerations of its forces: at the start of a motion
    solver    of these accelerations, where there is one
    known     values of jerk and d by the compiled start, each above its multipliers [n_v + rows, 2, lanes]; None: they are
              computed here. Both modes of gradients take them, so both begin with the same numbers
    """
    lag, scales = start_weights(weights)
    if known is not None and not isinstance(x.q, Pair):
        jerk, offset = known[: dynamics.topology.n_v].split(1, 1)
        return SmoothStart(jerk, offset, lag)

    def of_time(dynamics: Dynamics, t: Tensor, q: Any, v: Any, vd: Any, h: Any) -> tuple:
        T = dynamics.topology

        def third_rates(data: Data, at: Placement, q: Any, v: Any, vd: Any, h: Any) -> tuple:
            end = equations.placement(T, data, equations.advance(T, q, h * v), at_own_times(T, t[None] + h, data))
            here = equations.constraints(T, at)
            if not closed:  # what a step leaves of the rates is no third rate
                phi = equations.constraint_jets(T, at, data, v, vd, t)
                here = here + h * phi.velocity + (0.5 * h * h) * phi.acceleration
            return third_rates_of_constraints(T, data, end, here, v, vd, h)

        solver_there = solver or SaddleSolver(dynamics, t, q)
        return tuple(solver_there.along_constraints(third_rates, scales, (v, vd, h), known))

    jerk, offset = at_time(of_time, dynamics, t, x.q, x.v, x.vd, h)
    return SmoothStart(jerk, offset, lag)


def start_weights(weights: Weights) -> tuple[float, tuple[tuple[float, float], tuple[float, float]]]:
    """D, and the factors of om x om' and of the third rates of constraints in the jerk and in d (module header).

    weights   of a step of size one
    """
    lag = (weights.share - 1.0) / (1.0 - weights.a_from_a)
    rest = 1.0 / 6.0 - 0.5 * lag - weights.step_from_new
    return lag, ((1.0, 1.0), (rest + 1.0 / 12.0, rest))


def third_rates_of_constraints(T: Topology, data: Data, end: Placement, here: Any, v: Any, vd: Any, h: Any) -> tuple:
    """om x om' as rates [n_v, ...], and Phi_q (v'' - om x om') [rows, ...].

    end     placement at q o exp(h v), t + h
    here    Phi + h Phi' + h^2/2 Phi'' [rows, ...]
    """
    by_vd = (3.0 * reciprocal(h)) * equations.constraint_changes(T, end, data, vd)
    third = (6.0 * reciprocal(h * h * h)) * (here - equations.constraints(T, end)) - by_vd
    return _turning(T, v, vd), third


def _turning(T: Topology, v: Any, vd: Any) -> Any:
    """om x om' as rates [n_v, ...]."""
    turning = cross(equations.split_v(T, v)[1], equations.split_v(T, vd)[1])
    n, still = 3 * T.bodies, 0.0 * v
    return cat([still[:n], turning.flatten(0, 1), still[2 * n :]])
