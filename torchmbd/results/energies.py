"""Energies of a motion, and the work done on it.

    kinetic     1/2 v' M v                                        strain      1/2 w' Kr w and that of beam elements
    potential   - sum (m r + A S) . g                             dissipated  integral of w' . D w', and by beam elements
    applied     integral of sum f s'   (forces, with their own springs and dampers: multibody/forces/action.py)
    driven      integral of lam . dPhi/dt   (joints with a law of time)

    lost        at switches between phases: kinetic energy, by locks and impacts (drives may give some)

    balance = kinetic + strain + potential + dissipated + lost - applied - driven, less its value at the start

is zero along an exact motion; the rest is the error of steps and iterations. Integrals are trapezoidal over all states of a
lane (lane_motion.py): at all its steps, which are made again between checkpoints, and on both sides of every switch.
Values only. All functions of time [lanes, times] [J].
Checked in tests/physics/test_energies.py: against nodal sums, and the balance to second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.gradients import in_transform, is_differentiated
from torchmbd.math.pair import dot, matvec, value
from torchmbd.multibody.equations import beams, equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.moments import bent_stiffness, moments
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.equations.topology import Topology
from torchmbd.results.lane_motion import has_checkpoints, has_lane_times, lane_motion
from torchmbd.results.motion_data import MotionData
from torchmbd.summary import Summary


@dataclass(frozen=True, eq=False, repr=False)
class Energies(Summary):
    """Energies of a motion and the work done on it; see the module header."""

    kinetic: Tensor
    strain: Tensor
    potential: Tensor
    dissipated: Tensor
    applied: Tensor
    driven: Tensor
    lost: Tensor

    def _summary(self) -> list[tuple[str, str]]:
        return [
            (row.name, f"{float(x[0, 0]):.6g} to {float(x[0, -1]):.6g} J, at most {float(x[0].max()):.6g} J (lane 0)")
            for row in fields(self)
            for x in (getattr(self, row.name).detach(),)
        ]

    @property
    def stored(self) -> Tensor:
        """Kinetic, strain and potential energy together."""
        return self.kinetic + self.strain + self.potential

    @property
    def balance(self) -> Tensor:
        """Change of the energies since the start, less the work done: zero along an exact motion."""
        total = self.stored + self.dissipated + self.lost - self.applied - self.driven
        return total - total[:, :1]


def energies(motion: MotionData, lanes: Sequence[int] | None = None) -> Energies:
    """The energies of some lanes of a motion; None: of all."""
    if has_lane_times(motion) and len(motion.status) != motion.lanes:
        raise InputError(
            "motion",
            noun="energies",
            state="cannot be computed in torch.func.vmap if the designs have different times of steps or phases",
            hint="one simulate of all designs [lanes, ...], without vmap",
        )
    remade = has_checkpoints(motion)
    if remade and in_transform(motion.q):
        raise _refusal()
    parts = [_lane(motion, lane) for lane in (range(motion.lanes) if lanes is None else lanes)]
    result = [torch.stack(x) for x in zip(*parts, strict=True)]
    return Energies(*map(_without_gradient, result) if remade and is_differentiated(motion.q) else result)


def _refusal() -> InputError:
    return InputError(
        "checkpoint",
        noun="energies",
        state="have no gradient if simulate has a checkpoint above 1, because it keeps only some of the states",
        hint="simulate(..., checkpoint=1), or energies(motion) under torch.no_grad()",
    )


def _without_gradient(x: Tensor) -> Tensor:
    """The numbers of x, whose derivatives are refused."""

    def refuse(_: Tensor) -> None:
        raise _refusal()

    y = x.detach().requires_grad_()
    y.register_hook(refuse)
    return y


def _lane(motion: MotionData, lane: int) -> list[Tensor]:
    """Energies and works [times] of one lane: its times take the place of lanes."""
    T, (alone, begins, outputs) = motion.dynamics.topology, lane_motion(motion, lane, between=True)
    t, (q, v, lam) = alone.t, (alone.signals.values(name)[0].T[:, None] for name in ("q", "v", "lam"))
    data = {name: value(x) for name, x in motion.dynamics.data.items()}
    data = {name: x if x.shape[-1] == 1 else x[..., lane : lane + 1] for name, x in data.items()}
    at = equations.placement(T, data, q, as_lanes(T.schedule(t, data)))
    w, wd = at.w, equations.split_v(T, v)[2]
    plain = {name: x for name, x in data.items() if name not in ("gravity", "D")}
    strain = dissipation = torch.zeros_like(v[0])
    if T.flexible:
        strain = 0.5 * (w * matvec(data["Kr"], w)).sum((0, 1))
        plain["Kr"] = torch.zeros_like(data["Kr"])
        if "K2" in plain:
            strain = strain + (w * matvec(bent_stiffness(plain, w), w)).sum((0, 1)) / 6.0
            del plain["K2"]
        if "D" in data:
            dissipation = (wd * matvec(data["D"], wd)).sum((0, 1))
    if T.beams is not None:
        strain = strain + beams.stored_energy(T, data, at)
        rates = equations.beam_rates(T, data, at, v)
        dissipation = dissipation if rates is None else dissipation + beams.dissipation(T, data, at, rates)
    momentum = torch.cat([x.flatten(0, 1) for x in equations.inertia_forces(T, plain, at, torch.zeros_like(v), v)])
    energy = [0.5 * dot(v, momentum), strain, _potential(motion, data, at, q)]
    powers = [dissipation, _applied(motion, data, at, v, begins.cumsum(0)), _driven(T, data, t, q, lam)]
    drop = -energy[0][0].diff(prepend=energy[0][0, :1])
    lost = torch.where(begins, drop, 0.0).cumsum(0)
    works = [torch.nn.functional.pad(torch.cumulative_trapezoid(x[0], t), (1, 0)) for x in powers]
    valid = torch.where(torch.isfinite(q).all(0)[0], 0.0, torch.nan)  # nan after a failure, also of constant energies
    return [(x + valid)[outputs] for x in (*(e[0] for e in energy), *works, lost)]


def _potential(motion: MotionData, data: Data, at: equations.Placement, q: Tensor) -> Tensor:
    T = motion.dynamics.topology
    if "gravity" not in data:
        return torch.zeros_like(q[0])
    S = moments(T, data, at.w).S
    weight = data["mass"] * equations.split_q(T, q)[0] + matvec(at.A[:, :, : T.bodies], S)
    return -(weight * data["gravity"]).sum((0, 1))


def _applied(motion: MotionData, data: Data, at: equations.Placement, v: Tensor, phase: Tensor) -> Tensor:
    """Power of the applied forces [1, n]: generalized forces times rates; `phase`: number of the phase at each time."""
    T, power = motion.dynamics.topology, torch.zeros_like(v[0])
    for k, actions in enumerate(motion.actions or (T.actions,) * (1 + len(motion.switches))):  # of each phase
        if actions:
            topology = replace(T, actions=actions)
            on_vectors = equations.applied_on_vectors(topology, data, at, v)
            forces = equations.generalized_forces(topology, data, at, on_vectors)
            power = torch.where(phase == k, dot(torch.cat([x.flatten(0, 1) for x in forces]), v), power)
    return power


def _driven(T: Topology, data: Data, times: Tensor, q: Tensor, lam: Tensor) -> Tensor:
    """Power of the drives lam . dPhi/dt [1, n]: constraints without laws do no work."""
    power = torch.zeros_like(q[0])
    if not any(p.prescribes for p in T.primitives):
        return power
    still = q.new_zeros(T.n_v, 1, 1)
    for i, t in enumerate(times):
        at = equations.placement(T, data, q[..., i : i + 1], T.prescribed(t, data))
        power[:, i : i + 1] = dot(lam[..., i : i + 1], equations.constraint_rates(T, at, data, still, t))
    return power
