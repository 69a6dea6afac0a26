"""Static equilibrium as a motion: `equilibrium(system)` is a differentiable operation of PyTorch, as `simulate` is.

    parameters --structure stage--> data --Motion--> q, lam at rest at one or several times --torch--> responses

At each time drives and loads have the values of their laws at that time, and all forces on the mechanism balance: quasi-static
steps, each from the equilibrium before. Rates and accelerations are zero, or those of a steady rotation of the whole.
Checked in tests/integrate/test_equilibrium.py, tests/sensitivity/test_rest.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.diagnosis.elastic_limits import warn_of_displacements, warn_of_spin
from torchmbd.diagnosis.load_shares import warn_of_loads
from torchmbd.diagnosis.truncation import warn_static_truncation
from torchmbd.errors import DesignFailure, InputError, one_of, true_or_false
from torchmbd.integrate.arguments import checked_designs, start_of
from torchmbd.integrate.integrated_trajectory import plain, trajectory_of
from torchmbd.integrate.motion import Motion, Tensors
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.variables import lanes_of_batch, variable_names
from torchmbd.math.checked_numbers import reals
from torchmbd.math.module_call import exclusive
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.equilibrium.equilibrium import (
    SPIN,
    Balance,
    equilibrium_coordinates,
    find_equilibria,
    reactions,
)
from torchmbd.multibody.equilibrium.linearized import Linearization, Vibrations
from torchmbd.multibody.equilibrium.steady_rotation import TURNING, SteadyRotation
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.saddle.rank import Rank
from torchmbd.multibody.system import Dynamics, System
from torchmbd.registry import Registry
from torchmbd.results.history import History
from torchmbd.results.motion_data import OK, Switch
from torchmbd.results.trajectory import Trajectory

#: Functions of equilibria that extensions add, such as eigenvalues of vibrations about them.
OF_EQUILIBRIUM: Registry[Callable[..., Any]] = Registry("of_equilibrium", {})


def of_equilibrium(name: str) -> Callable[..., Any]:
    """A function of equilibria by its name; InputError if it is not installed."""
    if name not in OF_EQUILIBRIUM:
        noun = f"{name.replace('_', ' ')} of an equilibrium"
        raise InputError(name, noun=noun, state=f"are not known, because {OF_EQUILIBRIUM.missing(name)}")
    return OF_EQUILIBRIUM[name]


@dataclass(eq=False, repr=False)
class Equilibrium(Trajectory):
    """A motion at rest at each of its times. Like any motion it has coordinates, bodies, reactions and stresses.

    Its frequencies belong to small vibrations about the state at the last time. `rotation` is the steady rotation of the
    whole system; None at rest.

    >>> rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    >>> rest.q.shape, rest.reaction("hinge").force[0, 0].norm().item() > 0.0  # lanes, times, coordinates
    (torch.Size([1, 1, 7]), True)
    """

    rotation: SteadyRotation | None = None
    _known_eigenvalues: dict[Any, Tensor] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def vibrations(self) -> list[Vibrations]:
        """Small vibrations about the equilibrium at the last time, of each lane."""
        return [self._vibrations(lane, -1) for lane in range(self.lanes)]

    @property
    def frequencies(self) -> Tensor:
        """Natural frequencies [lanes, freedoms] [Hz] at the last time, without damping; see Vibrations.

        Differentiable like the motion. A derivative of a frequency that is zero or nan, or of a single frequency of several
        that coincide, raises InputError. Designs may retain different numbers of modes: frequencies of modes that a lane does
        not retain, but another lane does, are infinite and come last.
        """
        return self._eigenvalues("natural") / (2.0 * math.pi)

    @property
    def poles(self) -> Tensor:
        """Poles [lanes, 2 freedoms] [1/s], complex, at the last time, in rising order of the size of the imaginary part, then
        of the real one; differentiable as the frequencies are. Those of modes that a lane does not retain are infinite, with a
        real part of -inf."""
        return self._eigenvalues("poles")

    @property
    def damping_ratios(self) -> Tensor:
        """Damping ratios -Re s / |s| [lanes, freedoms] [-] of poles with a positive imaginary part, in rising order of it; nan
        in place of pairs that hardly oscillate, with imaginary parts below 1 % of |s|."""
        return of_equilibrium("damping_ratios")(self.poles)

    def _eigenvalues(self, kind: str) -> Tensor:
        key = kind, torch.is_grad_enabled()  # those of one mode have no graph
        if key not in self._known_eigenvalues:
            self._known_eigenvalues[key] = self.eigenvalues(kind).T
        return self._known_eigenvalues[key]

    def eigenvalues(self, kind: str, modes: Sequence[int] | None = None, symmetric: bool = False) -> Tensor:
        """Eigenvalues [k, lanes] at the last time of `kind` "natural" [rad/s] or "poles" [1/s].

        modes   their numbers from 0; None: all, infinite for modes that a lane does not retain
        """
        one_of("kind", kind, ("natural", "poles"))
        q = self.signals.history.q[-1]  # pyright: ignore[reportAttributeAccessIssue]
        return of_equilibrium("eigenvalues")(self.dynamics, q, self.t[-1], self.rotation, kind, modes, symmetric)

    @property
    def stable(self) -> bool:
        """True if no degree of freedom of any lane is unstable, at any time."""
        vibrations = [self._vibrations(lane, k) for lane in range(self.lanes) for k in range(len(self.t) - 1)]
        return not any(x.grow for x in [*vibrations, *self.vibrations])

    def _vibrations(self, lane: int, time: int) -> Vibrations:
        with torch.no_grad():
            dynamics = self.dynamics.values().select_lanes([lane])
            rotation = self.rotation and self.rotation.of_spin(dynamics.data[SPIN].detach())
            return Vibrations.of(
                Linearization.of(dynamics, self.q[lane, time].detach(), self.t[time].detach(), None, rotation)
            )


@dataclass(eq=False)
class StaticIntegration:
    """Equilibria at given times as an `Integration` of `Motion`; data of the model by `names` in, as ReverseIntegration.

    follow     the search of each lane starts at the equilibrium of the lane before
    unstable   as in `equilibrium`
    sweep      as in `find_equilibria`
    """

    model: Dynamics
    names: tuple[str, ...]
    times: Tensor
    follow: bool
    rotation: SteadyRotation | None = None
    unstable: bool = False
    sweep: int = 0
    dynamics: Dynamics = field(init=False)
    history: History = field(init=False)
    status: list[str] = field(init=False)
    validity: Tensor = field(init=False)
    outputs: Outputs = field(init=False)
    stats: dict[str, Any] = field(default_factory=dict, init=False)
    variables: tuple[str, ...] = ()
    switches: tuple[Switch, ...] = ()
    _balances: list[list[Balance]] = field(default_factory=list, init=False, repr=False)

    @property
    def duration(self) -> float:
        """The last time [s]."""
        return float(self.times[-1])

    @property
    def ranks(self) -> list[Rank]:
        """The rank of the constraints, all of which act."""
        return [self.dynamics.rank]

    @property
    def has_checkpoints(self) -> bool:
        """Return False: every equilibrium is kept."""
        return False

    def at_all_steps(self, lane: int) -> None:
        """Return None: every equilibrium is kept."""
        return None

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        self.dynamics = replace(self.model, data=dict(zip(self.names, inputs, strict=True)))
        q, _ = self.dynamics.initial.solve(self.dynamics)
        for t in self.times:
            balances = find_equilibria(
                self.dynamics,
                q,
                t,
                follow=self.follow,
                rotation=self.rotation,
                unstable=self.unstable,
                sweep=self.sweep,
            )
            self._require_balance(t, balances)
            self._balances.append(balances)
            q = equilibrium_coordinates(self.dynamics, balances, t, self.rotation)
        self.status = [OK] * self.dynamics.lanes
        q, v, a, lam = self._states(self.dynamics)
        self.history = History(q, v, a, lam, times=self.times)
        self.dynamics.evaluate_rank()
        self.validity = torch.tensor([[float(len(q))], [1.0]], dtype=torch.float64).expand(2, q.shape[-1])[:, None]
        self.outputs = Outputs([q, v, a, lam], self.validity.clone(), [], [], {}, [])
        return self.outputs.values()

    def tangents(self, directions: Tensors) -> list[Tensor]:
        data = self.dynamics.data
        moving = {n: Pair.of(data[n], dx) for n, dx in zip(self.names, directions, strict=True) if dx is not None}
        count = max(dx.shape[-2] for dx in directions if dx is not None)
        states = self._states(replace(self.dynamics, data=data | moving))
        by = [x[:, :, 1:] if x.shape[2] > 1 else x.new_zeros(*x.shape[:2], count, x.shape[3]) for x in states]
        return [*by, self.validity.new_zeros(2, count, len(self.status))]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        lanes = self.dynamics.lanes
        leaves = {
            name: leaf(x.expand(*x.shape[:-1], lanes).contiguous())
            for (name, x), needs_gradient in zip(self.dynamics.data.items(), needs_grad, strict=True)
            if needs_gradient
        }
        with torch.enable_grad():
            states = self._states(replace(self.dynamics, data=self.dynamics.data | leaves))
        pulled = [(y, bar) for y, bar in zip(states, outputs, strict=False) if bar is not None and y.requires_grad]
        if not pulled:
            return [None] * len(self.names)
        rows = max(bar.shape[-2] for _, bar in pulled)
        by_leaf: dict[str, list[Tensor]] = {name: [] for name in leaves}
        for row in range(rows):
            by = torch.autograd.grad(
                [y for y, _ in pulled],
                list(leaves.values()),
                [bar[..., row : row + 1, :].expand_as(y) for y, bar in pulled],
                retain_graph=True,
                allow_unused=True,
                materialize_grads=True,
            )
            for name, x in zip(leaves, by, strict=True):
                by_leaf[name].append(x)
        return [torch.cat(by_leaf[name], -2) if name in by_leaf else None for name in self.names]

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        return None

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        return history.least_norm_multipliers(self.dynamics.least_norm, self.duration, data)

    def _states(self, dynamics: Dynamics) -> list[Tensor]:
        """q, v, v' and lam [times, n, 1 + n_b, lanes] as functions of the data."""
        rows: list[list[Tensor]] = []
        for t, balances in zip(self.times, self._balances, strict=True):
            q = equilibrium_coordinates(dynamics, balances, t, self.rotation)
            lam = reactions(dynamics, q, t, self.rotation)
            still = value(q).detach().new_zeros(dynamics.topology.n_v, 1, value(q).shape[-1])
            v, a = still, still.clone()
            if self.rotation is not None:
                v, a = self.rotation.of_spin(dynamics.data[SPIN]).rates(dynamics.topology, q)
            rows.append([x.full if isinstance(x, Pair) else x for x in (q, v, a, lam)])
        return [torch.stack(x) for x in zip(*rows, strict=True)]

    def _require_balance(self, t: Tensor, balances: list[Balance]) -> None:
        """InputError for a lane without an equilibrium."""
        for lane, balance in enumerate(balances):
            if balance.failure:
                where = f" of lane {lane}" * (len(balances) > 1) + f" at t = {float(t):g} s" * (len(self.times) > 1)
                raise DesignFailure("system", state=balance.failure, noun=f"system{where}:")


@exclusive
def equilibrium(
    system: System,
    times: float | Sequence[float] | Tensor = 0.0,
    designs: Mapping[str, Tensor] | None = None,
    variables: Sequence[str] | None = None,
    start: Any = "assembled",
    follow: bool = False,
    spin: Sequence[float] | Tensor | None = None,
    center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    unstable: bool = False,
    observer: str = TURNING,
) -> Equilibrium:
    """Static equilibrium near the start: a motion at rest, with bodies, reactions, stresses, frequencies.

    A differentiable function of the parameters as `simulate` is, forward and reverse.

    system      the model; parameters that `designs` does not name keep their values
    times       of the loads and drives [s], ascending: quasi-static steps; each starts at the previous equilibrium
    designs     as in `simulate`; lanes
    variables   as in `simulate`
    start       where the search begins: "assembled", a motion, or numbers for bodies, as in `simulate`
    follow      the search of each lane starts at the equilibrium of the previous lane: a path of loads or other values,
                designs={"push.z": torch.linspace(0.0, -100.0, 11)}
    spin, center   angular velocity [rad/s], [3] or of each lane [lanes, 3], of the whole system about an axis through a point
                   [m] of the ground: the equilibrium is a steady rotation, with velocities and accelerations; a tensor has a
                   gradient
    observer    of the vibrations in a steady rotation: "turning" with the system, or in the "ground", for a round shaft in
                anisotropic bearings
    unstable    True: the equilibrium nearest to the start, also if its stiffness is not positive definite; False: the search
                decreases the energy. A shaft above its critical speed needs True: Coriolis forces stabilize it, and `stable`
                says so

    Raises InputError with the forces that remain if there is none; with flexible beams, whose loads grow in steps unless
    `unstable` is given, with the part of the loads at which the mechanism buckles or reaches a limit point. Otherwise a free
    or unstable equilibrium is returned: its frequencies are zero or nan, and degrees of freedom without stiffness stay where
    they are.

    >>> rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    >>> round(rest.vibrations[0].frequencies.item(), 4), rest.stable  # sqrt(9.81 / 2) / (2 pi) [Hz]
    (0.3525, True)
    """
    if not isinstance(system, System):
        raise InputError("system", system, "a System")
    follow, unstable = true_or_false("follow", follow), true_or_false("unstable", unstable)
    t = _times(times)
    rotation = SteadyRotation.of(spin, center, observer)
    initial = start_of(system, start)
    if initial.in_equilibrium:
        raise InputError(
            "start", start, "'assembled', a motion or numbers", state="is 'equilibrium', which this function computes"
        )
    system = system.starting(replace(initial, is_guess=True))
    design_values = checked_designs(system, designs)
    with torch.inference_mode(False), torch.set_grad_enabled(torch.is_grad_enabled()):
        warn_static_truncation(system)
        names = variable_names(system, design_values, "auto", variables, False)
        turning_lanes = 1 if rotation is None else rotation.spin.shape[-1]
        batch = lanes_of_batch(system, design_values, names, {"start": initial.lanes, "spin": turning_lanes})
        dynamics, shapes = system.stages(batch)
        data = dynamics.data | ({} if rotation is None else {SPIN: rotation.spin})
        integration = StaticIntegration(replace(dynamics, data={}), tuple(data), t, follow, rotation, unstable)
        outputs: Any = Motion.apply(integration, *data.values())
        if not torch.is_grad_enabled():
            shapes = {}
        motion = trajectory_of(system, integration, outputs, dict(data), batch, names, shapes)
        motion.stats["gradients"] = "reverse" if names else "none"
        motion.stats["backend"] = "eager"
        with torch.no_grad():
            warn_of_loads(plain(motion))
            warn_of_displacements(plain(motion))
        if rotation is not None:
            warn_of_spin(motion)
    values: dict[str, Any] = {f.name: getattr(motion, f.name) for f in fields(motion) if f.init}
    return Equilibrium(**values | {"t": t, "rotation": rotation})


def _times(times: Any) -> Tensor:
    """Ascending finite times [n] [s]."""
    t = reals("times", times).reshape(-1)
    if not len(t) or not bool(torch.isfinite(t).all()) or bool((t.diff() <= 0.0).any()):
        raise InputError("times", times, "finite times in ascending order [s]")
    return t
