"""Poles about the states of a motion at a time, with the coefficients of that time: differentiable as the motion is.

Checked in tests/extensions/vibrations/test_frozen_poles.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Complex
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.vibrations.eigenvalues import poles_of_matrices
from torchmbd.extensions.vibrations.moving_state import MovingLinearization, time_index
from torchmbd.math.module_call import exclusive, outside_transforms
from torchmbd.multibody.equilibrium.linearized import factored_inertia
from torchmbd.results.trajectory import Trajectory
from torchmbd.simulation.equilibrium import Equilibrium


@exclusive
def frozen_poles(
    motion: Trajectory, time: float | None = None, coordinates: Sequence[str] | None = None
) -> Complex[Tensor, "lanes poles"]:
    """Poles [lanes, 2 freedoms] [1/s] of the equations linearized along a motion, their coefficients frozen at a time.

    motion        of `simulate`, without phases
    time          one of its times [s]; None: the last one
    coordinates   names of independent increments, as in `linearize`; the poles depend on this choice. None: independent modes
                  and rotations first, then displacements. The choice for the first lane applies to all lanes

    The order is by the size of the imaginary part, then by the real part. Differentiable like the motion, in both modes.
    A single pole of several that coincide does not have a derivative, and neither has a defective pair: InputError names
    them. Lanes that failed raise SimulationFailure. Designs are lanes of one motion: torch.vmap over designs raises an error.

    >>> motion = mbd.simulate(mbd.examples.pendulum(length=2.0), 0.5, steps=50)
    >>> angle = mbd.Angle("bob", "z")(motion)[0, -1]
    >>> s = mbd.vibrations.frozen_poles(motion)[0, 1]
    >>> round((s.imag**2 / torch.cos(angle)).item(), 3)  # g / L
    4.905
    """
    if not isinstance(motion, Trajectory) or isinstance(motion, Equilibrium):
        raise InputError("motion", motion, "a motion of mbd.simulate", hint="`poles` of the equilibrium")
    k, states = time_index(motion, time, "motion"), []
    if outside_transforms(lambda q: q.shape[-1], motion.q.movedim(0, -1)) > motion.lanes:
        raise InputError(
            "motion",
            motion,
            "must have designs as lanes of one motion",
            state="was simulated under torch.vmap over designs",
        )
    for lane in range(motion.require_ok().lanes):
        dynamics = motion.dynamics.select_lanes([lane])
        q, v = (x[lane, k][:, None, None] for x in (motion.q, motion.v))
        states.append(MovingLinearization.of(dynamics, q, v, motion.t[k], coordinates))
        factored_inertia(states[-1].M.detach())
        coordinates = [dynamics.topology.rate_name(row) for row in states[0].rows]
    M, C, K = (torch.stack([getattr(x, name) for x in states], -1) for name in "MCK")
    return poles_of_matrices(M, C, K).T
