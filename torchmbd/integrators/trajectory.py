"""The result of a simulation: coordinates, rates, accelerations, multipliers, and their sensitivities.

Presented lanes (designs) first, then time, then components, the design axis last:

    t [times]   q [lanes, times, n_q]   v, a [lanes, times, n_v]   lam [lanes, times, rows]
    dq_db [lanes, times, n_q, n_b]   dv_db, da_db [lanes, times, n_v, n_b]   dlam_db [lanes, times, rows, n_b]

`moved(delta)` is the neighbor of a motion to first order in the design: the derivative of any function f of a motion is
the Jacobian of f(motion.moved(delta)) at zero.
A lane that failed says why in `status`; its numbers are nan from the failure on and must not be used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import SimulationFailure, unknown
from torchmbd.forces.action import Action
from torchmbd.integrators.body_motion import BodyMotion
from torchmbd.integrators.energies import Energies, energies
from torchmbd.integrators.reaction import JointReaction, reaction
from torchmbd.integrators.singular import SingularPosition, singular_positions
from torchmbd.numerics.called import called
from torchmbd.numerics.pair import Pair
from torchmbd.system.dynamics import Dynamics

OK = "ok"


@dataclass(frozen=True, eq=False)
class Moment:
    """The state of all lanes on one side of a switch [lanes, n], with sensitivities [lanes, n, n_b]."""

    q: Tensor
    v: Tensor
    a: Tensor
    lam: Tensor
    dq_db: Tensor | None = None
    dv_db: Tensor | None = None
    da_db: Tensor | None = None
    dlam_db: Tensor | None = None

    def moved(self, delta: Tensor) -> Moment:
        """Of all designs moved by delta [n_b], to first order."""
        names = ("q", "v", "a", "lam")
        return Moment(*(_move(getattr(self, name), getattr(self, f"d{name}_db"), delta) for name in names))


@dataclass(frozen=True, eq=False)
class Switch:
    """The passage of all lanes into a phase; sensitivities follow the time of the switch, which moves with the design.

    t [lanes] (inf: a lane that does not get there), dt_db [lanes, n_b]; before, after: equal positions
    """

    phase: str
    t: Tensor
    before: Moment
    after: Moment
    dt_db: Tensor | None = None

    def moved(self, delta: Tensor) -> Switch:
        """Of all designs moved by delta [n_b], to first order."""
        t = _move(self.t, self.dt_db, delta)
        return Switch(self.phase, t, self.before.moved(delta), self.after.moved(delta))


def _move(x: Tensor, dx: Tensor | None, delta: Tensor) -> Tensor:
    return x if dx is None else x + dx @ delta


@dataclass(eq=False)
class Trajectory:
    """A motion of one design or of a batch; see the module header for shapes.

    status      for each lane "ok" or the reason of the failure
    stats       what the integrator counted
    designs     parameters of the lanes by name, [lanes, ...]
    parameters  names of the design variables of the sensitivities, one for each slot
    switches    passages into the second phase and all later ones
    actions     applied forces of each phase; none: of all the same
    """

    t: Tensor
    q: Tensor
    v: Tensor
    a: Tensor
    multipliers: Callable[[], tuple[Tensor, Tensor | None]] = field(repr=False)
    status: list[str]
    stats: dict[str, Any]
    system: Any
    dynamics: Dynamics
    dq_db: Tensor | None = None
    dv_db: Tensor | None = None
    da_db: Tensor | None = None
    designs: dict[str, Tensor] = field(default_factory=dict)
    parameters: tuple[str, ...] = ()
    switches: list[Switch] = field(default_factory=list)
    actions: tuple[tuple[Action, ...], ...] = ()
    _views: dict[str, BodyMotion] = field(default_factory=dict, repr=False)
    _modes: dict[str, Tensor] = field(default_factory=dict, repr=False)
    _mode_tangents: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @cached_property
    def _lam(self) -> tuple[Tensor, Tensor | None]:
        return self.multipliers()

    @property
    def lam(self) -> Tensor:
        """Multipliers [lanes, times, rows]; those of condensed joints are computed when somebody asks."""
        return self._lam[0]

    @property
    def dlam_db(self) -> Tensor | None:
        """Their sensitivities [lanes, times, rows, n_b]."""
        return self._lam[1]

    @property
    def ok(self) -> bool:
        """Whether every lane succeeded."""
        return all(status == OK for status in self.status)

    def require_ok(self) -> Trajectory:
        """Return self, or raise SimulationFailure with the first reason."""
        for lane, status in enumerate(self.status):
            if status != OK:
                raise SimulationFailure(f"lane {lane}: {status}")
        return self

    def body(self, name: str) -> BodyMotion:
        """The motion of one body."""
        if name not in self.dynamics.topology.names:
            raise unknown("body", name, self.dynamics.topology.names)
        if name not in self._views:
            self._views[name] = BodyMotion(self, name)
        return self._views[name]

    def reaction(self, joint: str) -> JointReaction:
        """Force and torque of a joint on its second body, in the frame of its first."""
        return reaction(self, joint)

    @cached_property
    def energies(self) -> Energies:
        """Kinetic, strain and potential energy, what was dissipated, and the work of forces and drives, over time."""
        return energies(self)

    def singular_positions(self) -> list[SingularPosition]:
        """Where and when the motion came near a position at which its constraints lose rank."""
        return singular_positions(self)

    def coordinates(self, rows: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """Chosen rows of q [lanes, times, k] and their sensitivities [lanes, times, k, n_b]."""
        index = torch.as_tensor(list(rows), device=self.q.device)
        return self.q[..., index], None if self.dq_db is None else self.dq_db[..., index, :]

    def modes(self, name: str) -> Tensor:
        """Mode shapes [lanes, nodes, 6, modes] of a flexible body: the structure stage of the designs, once more."""
        if name not in self._modes:
            with torch.no_grad():
                self._modes[name] = self._structure(name, self.designs)
        return self._modes[name]

    def _structure(self, name: str, designs: dict[str, Tensor]) -> Tensor:
        psi = called(self.system, designs, name)["psi"]
        return psi if psi.dim() == 4 else psi[None].expand(self.q.shape[0], *psi.shape)

    def prepare_modes(self) -> None:
        """Differentiate the mode shapes that were asked for, so that `moved` carries them."""
        zero = self.q.new_zeros(len(self.parameters))
        for name in self._modes.keys() - self._mode_tangents.keys():
            with torch.no_grad():
                psi = torch.func.jacfwd(lambda d, name=name: self._structure(name, self._moved_designs(d)))(zero)
            self._mode_tangents[name] = psi

    def _moved_designs(self, delta: Tensor) -> dict[str, Tensor]:
        moved, start = dict(self.designs), 0
        for name in dict.fromkeys(label.rpartition("[")[0] for label in self.parameters):
            shape = self.designs[name].shape[1:]
            moved[name] = self.designs[name] + delta[start : start + shape.numel()].reshape(shape)
            start += shape.numel()
        return moved

    def moved(self, delta: Tensor) -> Trajectory:
        """The motion of all designs moved by delta [n_b], to first order; delta may carry tangents.

        Needs sensitivities, and `prepare_modes` for functions that look at mode shapes.
        """

        def move(x: Tensor, dx: Tensor | None) -> Tensor:
            return _move(x, dx, delta)

        data = {
            name: x.value + (x.tangent * delta[:, None]).sum(-2, keepdim=True) if isinstance(x, Pair) else x
            for name, x in self.dynamics.data.items()
        }
        return Trajectory(
            t=self.t,
            q=move(self.q, self.dq_db),
            v=move(self.v, self.dv_db),
            a=move(self.a, self.da_db),
            multipliers=lambda: (move(*self._lam), None),
            status=self.status,
            stats=self.stats,
            system=self.system,
            dynamics=replace(self.dynamics, data=data),
            designs=self._moved_designs(delta),
            switches=[switch.moved(delta) for switch in self.switches],
            actions=self.actions,
            _modes={name: move(psi, self._mode_tangents.get(name)) for name, psi in self._modes.items()},
        )

    def at_moment(self, lane: int, t: Tensor, moment: Moment) -> Trajectory:
        """One lane at one side of a switch at its time t [], as a motion of one time without sensitivities."""
        one = slice(lane, lane + 1)
        return replace(
            self,
            t=t[None],
            q=moment.q[one, None],
            v=moment.v[one, None],
            a=moment.a[one, None],
            multipliers=lambda: (moment.lam[one, None], None),
            status=self.status[one],
            dynamics=self.dynamics.some([lane]),
            dq_db=None,
            dv_db=None,
            da_db=None,
            designs={name: x[one] for name, x in self.designs.items()},
            parameters=(),
            switches=[],
            _views={},
            _modes={name: psi[one] for name, psi in self._modes.items()},
            _mode_tangents={},
        )
