"""One function for all integrators: `simulate(system, duration, method=...)`, a differentiable operation of PyTorch.

"generalized_alpha" (default) integrates the index-3 equations with equal steps; every method of torchdiffeq goes by its
own name on the index-1 form. Both return the same Trajectory and agree within their tolerances
(tests/convergence/test_two_routes.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchmbd.errors import argument_names, keyword_hints
from torchmbd.integrate.phases.phase import Phase
from torchmbd.integrate.registry import DEFAULT
from torchmbd.math.module_call import exclusive
from torchmbd.multibody.system import System
from torchmbd.results.trajectory import Trajectory
from torchmbd.simulation.simulation import Simulation


@keyword_hints
@exclusive
def simulate(
    system: System,
    duration: float | Tensor,
    method: str = DEFAULT,
    steps: int | None = None,
    designs: Mapping[str, Tensor] | None = None,
    phases: Sequence[Phase] | None = None,
    gradients: str = "auto",
    variables: Sequence[str] | None = None,
    backend: str = "auto",
    start: str | Mapping[str, Any] | Trajectory = "assembled",
    progress: bool | None = None,
    diagnose: bool = True,
    **options: Any,
) -> Trajectory:
    """Simulate one design, or a batch of independent designs (lanes): `Simulation(...)(designs)`.

    The motion is a differentiable function of the parameters, as any operation of torch: of `designs` and of parameters of
    the system that require a gradient, in grad mode and under torch.func. Second derivatives raise an error.

    system      the model; parameters that `designs` does not name keep their values
    duration    simulated time [s], positive; a tensor [] has a gradient: the number of steps stays, their size changes
    method      "generalized_alpha", "hht_alpha", or a method of torchdiffeq, such as "dopri5" or "rk4"
    steps       equal time steps, and output intervals; default: as many as drives, loads and the vibrations that they excite
                need, by the estimated error of a step, at least 200 (how-to "Choose steps"); `stats["steps"]` says how many.
                Adaptive methods choose their own steps between the outputs
    designs     parameter name -> values [lanes, ...], or [...] for one lane; other parameters keep their values
    phases      a list of Phase, one after the other; default: a single phase without locks or releases
    gradients   "reverse": by the adjoint of the steps. With native code the motion with its gradient costs about 1.5
                simulations, and 0.12 for each response, whatever the number of variables; one-step methods, such as
                generalized_alpha. "forward": by tangents that are integrated with the motion, about 2 simulations, and 0.1
                for each variable; then the motion has `dq_db` as well. "auto": reverse where there is an adjoint, else
                forward, by what requires a gradient or is under torch.func. "none": values only
    backend     what makes the steps: "native" (C++, compiled once for kinds of joints and forces), "eager" (operators of torch,
                the reference) or "auto": native where there is a compiler and all laws can be traced. The same call gives the
                same numbers every time
    start       "assembled": bodies as they were given, joints closed, flexible bodies undeformed or `bent`. "equilibrium": at
                rest under gravity and forces, drives where they are at t = 0. A motion: its last state, where time begins at 0
                again, also for laws of drives and loads; its locks do not act. Or numbers [...] or [lanes, ...] for
                some bodies, {"rod.modal": ..., "load.velocity": ...}: position, axes, velocity, angular_velocity, modal,
                modal_velocity. Then joints are closed and velocities made compatible
    progress    a bar of the simulated time on standard error; None: in a terminal or a notebook, where the motion takes more
                than three seconds
    variables   names of the parameters whose gradients are wanted; default with "forward" and "reverse": all that require
                a gradient
    diagnose    False: without the warnings of what the model leaves out, such as stiffening by loads, and without the time
                that they take, up to half of a first motion. The status is the same
    options     of the method: the fields of its class in registry.py. generalized_alpha: spectral_radius, iterations, refresh;
                halvings, and checkpoint=k, which keeps every k-th state; torchdiffeq: rtol, atol, options

    `status` reports a lane that fails; it is nan from there on and adds nothing to a gradient. `status` also reports a lane
    whose steps do not resolve its vibrations; this lane has all numbers. `stats` has the mode of gradients, the backend and
    the number of threads that made the steps.
    Threads that simulate wait for each other: use processes, or lanes. Raises InputError for bad arguments.

    >>> motion = mbd.simulate(mbd.examples.arm(), duration=0.1, steps=40)
    >>> motion.status, motion.q.shape  # lanes, times, coordinates
    (['ok'], torch.Size([1, 41, 16]))
    >>> designs = {"arm.laminate.angles": mbd.deg([[0.0, 90.0], [45.0, -45.0]])}
    >>> both = mbd.simulate(mbd.examples.arm(), 0.1, steps=40, designs=designs)  # two designs at once
    >>> mbd.Max(mbd.StrainEnergy("arm"))(both).shape
    torch.Size([2])
    """
    simulation = Simulation.of_caller(
        argument_names(simulate),
        system,
        duration,
        method=method,
        steps=steps,
        phases=phases,
        backend=backend,
        start=start,
        **options,
    )
    return simulation(designs, gradients, variables, progress, diagnose)
