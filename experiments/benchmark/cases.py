"""Mechanisms of the benchmark: systems with a batch of designs, their motion stage, and what is looked at."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.peers import closed_loops, exudyn_peer
from torchmbd.design.spline import Spline
from torchmbd.examples import slider_crank
from torchmbd.extensions.native import library
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.motion import Motion
from torchmbd.integrate.phases.segment import single_segment
from torchmbd.integrate.registry import DEFAULT, integrator_of
from torchmbd.integrate.reverse_integration import ReverseIntegration
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system import Dynamics
from torchmbd.results.history import History

Observed = Callable[[Dynamics, History], Tensor]  # histories and their design tangents [1 + n_b, lanes, times]
LINK, WIDTH = 0.3, 0.03  # of a link of the pendulum chain [m]


@dataclass(frozen=True)
class Case:
    """A mechanism with its design variables.

    variables  parameters that are design variables, with the half-width in which designs lie around the system's own
    """

    title: str
    system: mbd.System
    duration: float
    variables: Mapping[str, float]
    peer: Callable[..., Any]  # the same in Exudyn: (system, designs) -> simulations

    @property
    def count(self) -> int:
        parameters = dict(self.system.named_parameters())
        return sum(parameters[name].numel() for name in self.variables)

    def designs(self, lanes: int) -> dict[str, Tensor]:
        """Designs [lanes, ...], the same in every run."""
        parameters = dict(self.system.named_parameters())
        make = torch.Generator().manual_seed(7)
        result = {}
        for name, width in self.variables.items():
            x = parameters[name].detach()
            result[name] = x + width * (2.0 * torch.rand(lanes, *x.shape, generator=make, dtype=x.dtype) - 1.0)
        return result

    def dynamics(self, lanes: int, gradients: bool) -> Dynamics:
        return self.system.dynamics(self.designs(lanes), tangents=list(self.variables) if gradients else [])


def crank3(modes: int = 8, cells: tuple[int, int] = (24, 4)) -> Case:
    """The slider-crank of the paper, three layers, three angles."""
    system = slider_crank.build(3, modes=modes, cells=cells, joint="spherical")
    return Case(
        "slider-crank, 3 angles", system, slider_crank.DURATION, {"rod.laminate.angles": 0.1}, exudyn_peer.slider_crank
    )


def crank8(modes: int = 8, cells: tuple[int, int] = (24, 4)) -> Case:
    """Four layers, their angles and thicknesses."""
    system = slider_crank.build(4, modes=modes, cells=cells, joint="spherical")
    variables = {"rod.laminate.angles": 0.1, "rod.laminate.thickness": 0.1 * slider_crank.THICKNESS / 4}
    title = "slider-crank, 4 angles, 4 thicknesses"
    return Case(title, system, slider_crank.DURATION, variables, exudyn_peer.slider_crank)


def pendulum(links: int = 2, modes: int = 8, cells: tuple[int, int] = (16, 2), duration: float = 0.06) -> Case:
    """A chain of laminated links on spherical joints, level at the start, released under gravity; three angles each."""
    ply = mbd.Ply(**slider_crank.CARBON)
    axes = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    bodies = []
    for i in range(links):
        laminate = mbd.Laminate(ply, angles=mbd.deg([45, -45, 45]), thickness=1e-3)
        mesh = mbd.mesh.rectangle(length=LINK, width=WIDTH, cells=cells)
        at = ((i + 0.5) * LINK, 0, 0)
        bodies.append(mbd.FlexibleBody.plate(f"link{i}", mesh, laminate, modes=modes, position=at, axes=axes))
    ends = [mbd.Ground().at(0, 0, 0), *(body.at("right") for body in bodies)]
    joints = [mbd.Spherical(end, body.at("left")) for end, body in zip(ends, bodies, strict=False)]
    system = mbd.System(bodies, joints, gravity=(0.0, -9.81, 0.0))
    variables = {f"link{i}.laminate.angles": 0.5 for i in range(links)}
    return Case(f"pendulum of {links} laminated links", system, duration, variables, exudyn_peer.chain)


def loops(modes: int = 8, cells: tuple[int, int] = (16, 2), duration: float = 0.06) -> Case:
    """The cube of experiments/peers/closed_loops.py, three angles of each of its twelve links."""
    variables = {f"link{i}.laminate.angles": 0.5 for i in range(12)}
    return Case("closed loops", closed_loops.build(modes, cells), duration, variables, closed_loops.peer)


def energy(dynamics: Dynamics, history: History) -> Tensor:
    """Strain energy of all flexible bodies and its design tangents [1 + n_b, lanes, times]."""
    T = dynamics.topology
    w = history.rows(0, range(7 * T.bodies, T.n_q)).movedim(0, -1).unflatten(0, (T.modes, T.flexible))
    still = w[:, :, 0]  # [modes, bodies, lanes, times]
    Kr = dynamics.data["Kr"]  # [modes, modes, bodies, pair, lanes]
    force = torch.einsum("abfl,bflt->aflt", value(Kr)[:, :, :, 0], still)
    U = (force.unsqueeze(2) * w).sum((0, 1))
    U[0] *= 0.5
    if isinstance(Kr, Pair):
        products = (still.unsqueeze(1) * still).flatten(0, 2)  # [modes modes bodies, lanes, times]
        U[1:] += 0.5 * torch.einsum("ksl,klt->slt", Kr.tangent.flatten(0, 2), products)
    return U


def measures(t: Tensor, U: Tensor) -> Tensor:
    """Peak and integral of histories U [..., times]: [2, ...]."""
    return torch.stack([Spline.of(t, U).maximum(), torch.trapezoid(U, t, dim=-1)])


def responses(duration: float, U: Tensor) -> tuple[Tensor, Tensor]:
    """Peak and integral of the energy [2, lanes] and their gradients [2, lanes, n_b]."""
    zero = U.new_zeros(len(U) - 1)
    gradient = torch.func.jacfwd(lambda d: responses_of(duration, U[0] + torch.einsum("slt,s->lt", U[1:], d)))(zero)
    return responses_of(duration, U[0]), gradient  # type: ignore[return-value]


def responses_of(duration: float, U: Tensor) -> Tensor:
    """Peak and integral of energies [..., times] over the duration: [2, ...]."""
    return measures(torch.linspace(0.0, duration, U.shape[-1], dtype=U.dtype, device=U.device), U)


def motion(
    dynamics: Dynamics, duration: float, steps: int, observed: Observed = energy, **options: Any
) -> tuple[Tensor, Tensor]:
    """The motion stage of a batch: from frozen dynamics to `responses` of what is observed."""
    with torch.no_grad():
        integrator = integrator_of(DEFAULT, options).with_defaults(dynamics.topology)
        problem = InitialValueProblem.of_dynamics(with_backend(dynamics, "auto"), duration)
        history = problem.integrate(integrator, steps).history
        U = observed(dynamics, history)
        return responses(duration, U) if len(U) > 1 else (responses(duration, U)[0], U.new_zeros(0))


def differentiable_motion(
    dynamics: Dynamics, duration: float, steps: int, names: Collection[str] = (), observed: Observed = energy
) -> tuple[Tensor, dict[str, Tensor]]:
    """`responses` [2, lanes] as a function of data, those of `names` and those that move with the design, by the adjoint."""
    moving = [name for name, x in dynamics.data.items() if isinstance(x, Pair) or name in names]
    data = {name: value(x).detach().requires_grad_(name in moving) for name, x in dynamics.data.items()}
    model = replace(dynamics, data={})
    integrator = GeneralizedAlpha().with_defaults(dynamics.topology)
    integration = ReverseIntegration(
        names=tuple(data),
        designs=(),
        differentiated=tuple(moving),
        duration=duration,
        steps=steps,
        system=None,
        segments=single_segment(model),
        model=model,
        integrator=integrator,
    )
    outputs: Any = Motion.apply(integration, *data.values())
    q, v, vd, lam = outputs[:4]
    history = History(q, v, vd, lam, integration.expansion(data))
    responses = responses_of(duration, observed(replace(dynamics, data=data), history)[0])
    return responses, {name: data[name] for name in moving}


def motion_backwards(
    dynamics: Dynamics, duration: float, steps: int, names: Collection[str] = (), observed: Observed = energy
) -> tuple[Tensor, Tensor]:
    """As `motion`, with the gradients of both responses by the adjoint of the steps.

    names   of data; the gradients are then by these alone, [2, n, lanes]
    """
    responses, leaves = differentiable_motion(dynamics, duration, steps, names, observed)
    rows = responses.sum(-1)
    slopes = torch.vmap(lambda weights: torch.autograd.grad(rows, list(leaves.values()), weights, retain_graph=True))(
        torch.eye(2, dtype=torch.float64)
    )
    if names:
        return responses.detach(), torch.cat([by.flatten(1, -3)[:, :, 0] for by in slopes], 1)
    parts = [
        torch.einsum("rkl,kbl->rlb", by.flatten(1, -3)[:, :, 0], dynamics.data[name].tangent.flatten(0, -3))
        for name, by in zip(leaves, slopes, strict=True)
    ]
    return responses.detach(), torch.stack(parts).sum(0)


@contextlib.contextmanager
def compilation(wanted: bool) -> Iterator[None]:
    """Switch compiled code on or off within a block."""
    before = os.environ.get("TORCHMBD_COMPILE")
    os.environ["TORCHMBD_COMPILE"] = "1" if wanted else "0"
    try:
        yield
    finally:
        if before is None:
            del os.environ["TORCHMBD_COMPILE"]
        else:
            os.environ["TORCHMBD_COMPILE"] = before


def compiled_ready(dynamics: Dynamics, build: bool = True) -> bool:
    """Whether native code serves these dynamics; a missing one is built now if `build`. False: it cannot be."""
    with compilation(True):
        if unavailable() is not None:
            return False
        if not build and not all(library.path_of(dynamics.condensed(), kind).exists() for kind in ("step", "adjoint")):
            return False
        try:
            native = with_backend(dynamics, "native").condensed()
        except mbd.InputError:
            return False
        return library.library(native, "adjoint") is not None


def interleaved(functions: Mapping[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Processor seconds of the fastest of several runs, taken in turns: other programs on the machine affect all alike.

    A function that returns a float has measured itself.
    """
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeat):
        for name, function in functions.items():
            with mbd.threads(1):
                start = time.process_time()
                spent = function()
                seconds[name].append(spent if isinstance(spent, float) else time.process_time() - start)
    return {name: min(times) for name, times in seconds.items()}
