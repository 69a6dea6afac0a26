"""What the retained modes of flexible bodies leave out of their flexibility at joints and forces: a body is too stiff there.

    R = F' K^-1 F - (Psi' F)' Kr^-1 (Psi' F)          residual flexibility under unit loads F at the frames of a body
    C = sum over bodies W' R W                        W: loads on its frames of unit multipliers

    M x'' + K x + Phi_q' lam = 0,  Phi_q x = C lam    vibrations with the residual flexibility in the joints

    joints   1 - (f / f0)^2 of the first elastic vibration of the system, and those up to twice as fast; f0 without C, f with it
    forces   w'R w beside the largest w'G w of forces (or moments) at the same frame, G = F' K^-1 F

Of the present design at its initial position, drives held. Residual masses are left out. Bodies that were reduced elsewhere
have no K, and no residual flexibility.
Source: MacNeal, Comput. Struct. 1 (1971) 581-601 (residual flexibility).
Checked in tests/multibody/system/test_truncation.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor

from torchmbd.errors import MbdError, warn
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.joints.joint import Attached
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.linearized import Linearization, Vibrations

_NEAR = 2.0  # times the first elastic frequency: vibrations that are looked at
LARGEST = 300  # rates of a system whose vibrations are looked at: dense methods
_LOOKED_AT: WeakSet[Any] = WeakSet()  # bodies; no attribute of a system, which is what it is made of (math/digest.py)
_REGULAR = 1e-12  # of the largest flexibility in the joints: redundant rows are determined by it
_SHOWN = 4  # nodes in a message
_ELASTIC = 0.2  # of the energy of a vibration that is elastic
_RIGID = 1e-5  # of the highest frequency: freedoms without stiffness are below
_SHIFT = 1e-2  # of the first elastic frequency: a stiffness that makes these regular


@dataclass(frozen=True)
class StaticTruncation:
    """What is left out in one system.

    share         of the stiffness that is too much, 0 to 1: of a vibration, or of the deflection under a force
    frequencies   of the vibration as it is and with the residual flexibility [Hz]; None: of a force
    body, where   the body with most of it, and its frame
    advice        the better setting
    """

    share: float
    frequencies: tuple[float, float] | None
    body: str
    where: str
    advice: str

    def __str__(self) -> str:
        what = f"{100 * self.share:.2g} % of the deflection of body {self.body!r} under a force at {self.where}"
        if self.frequencies is not None:
            with_modes, exact = self.frequencies
            what = (
                f"flexibility of body {self.body!r} at {self.where}: a vibration of {exact:.3g} Hz comes out as "
                f"{with_modes:.3g} Hz"
            )
        return f"the retained modes leave out {what}; better: {self.advice}"


@dataclass(frozen=True)
class _Residual:
    """Of a body: its mounts, G and R of unit forces and moments at these [6 mounts, 6 mounts]."""

    body: Any
    number: int
    mounts: list[InterpolationConstraint]
    G: Tensor
    R: Tensor


def static_truncation(system: Any) -> StaticTruncation | None:
    """The largest share of a system; None: none of its joints and forces acts on a flexible body with a stiffness."""
    T = system.topology
    if not T.attached_flexible:
        return None
    dynamics, stages = system.stages({})
    dynamics = dynamics.values().select_lanes([0])
    with torch.no_grad():
        residuals = [x for x in (_residual(system, dynamics, stages, k) for k in range(T.flexible)) if x is not None]
        q, v = dynamics.start
        t = q.new_zeros(())
        at = equations.placement(T, dynamics.data, q, T.prescribed(t, dynamics.data))
        found = [_of_forces(residual, T, _action_loads(dynamics, at, v)) for residual in residuals if T.actions]
        if T.rows and T.n_v <= LARGEST and residuals:
            loads = equations.force_on_vectors(T, at, torch.eye(T.rows, dtype=q.dtype)[:, None])
            found.append(_of_joints(residuals, T, Linearization.of(dynamics, q[:, 0, 0], t), _local(T, at, loads)))
    return max((x for x in found if x is not None), key=lambda x: x.share, default=None)


def warn_static_truncation(system: Any) -> None:
    """Warn where the share exceeds the system's limit; each body is looked at once."""
    bodies = [system.body(name) for name in system.topology.names[: system.topology.flexible]]
    if system.truncation is None or all(body in _LOOKED_AT for body in bodies):
        return
    _LOOKED_AT.update(bodies)
    try:
        found = outside_transforms(lambda: static_truncation(system))
    except (
        MbdError,
        RuntimeError,
    ):  # what is wrong with the present design, the simulation of the others need not have
        return
    if found is not None and found.share > system.truncation:
        warn(f"{found}. System(..., truncation=None) does not look")


def _residual(system: Any, dynamics: Any, stages: dict[str, Tensor], k: int) -> _Residual | None:
    T = dynamics.topology
    body, n = system.body(T.names[k]), T.own_modes[k]
    found = body.flexibility()
    own = [T.attached[i] for i in range(T.attached_flexible) if int(T.vector_flexible[i]) == k]
    mounts = [x.interpolation for x in own if x.interpolation is not None]
    mounts = [mount for mount in dict.fromkeys(mounts) if not set(mount.nodes) <= set(body.reference)]
    if found is None or not mounts:
        return None
    K, expand = found
    x = body.mesh.nodes - body.origin
    F = _unit_loads(x, mounts, expand, K.size)
    G = F.T @ StaticLoads(K.pattern)(K, F)
    psi = stages[body.name].detach()
    moved = torch.cat([mount.motion(x, psi.reshape(-1, *psi.shape[-3:])[0]) for mount in mounts])  # [6 mounts, modes]
    R = G - moved @ torch.linalg.solve(dynamics.data["Kr"][:n, :n, k, 0, 0], moved.T)
    return _Residual(body, k, mounts, 0.5 * (G + G.T), 0.5 * (R + R.T))


def _unit_loads(x: Tensor, mounts: Sequence[InterpolationConstraint], expand: Any, size: int) -> Tensor:
    """Loads on the free freedoms [size, 6 mounts] of unit forces and moments: the transpose of the motion of the mounts."""
    with torch.enable_grad():
        u = torch.zeros(size, 1, dtype=x.dtype, requires_grad=True)
        psi = expand(u)
        moved = torch.cat([mount.motion(x, psi)[:, 0] for mount in mounts])
        columns = [torch.autograd.grad(y, u, retain_graph=True)[0][:, 0] for y in moved]
    return torch.stack(columns, 1)


def _local(T: Any, at: Any, forces: Tensor) -> Tensor:
    """Forces on vectors [3, vectors, 1, columns] in the axes of flexible bodies [columns, vectors, 3]."""
    return torch.einsum("ijv,ivc->cvj", at.A_of[..., 0, 0], forces[:, :, 0])[:, : T.attached_flexible]


def _action_loads(dynamics: Any, at: Any, v: Tensor) -> Tensor:
    """Of unit strengths of the actions [actions, vectors, 3]."""
    T = dynamics.topology
    count, start, strengths = sum(len(action.members[0]) for action in T.actions), 0, []
    for action, (_, _, direction) in zip(T.actions, equations.action_states(T, dynamics.data, at, v), strict=True):
        n = len(action.members[0])
        unit = torch.eye(count, dtype=v.dtype)[start : start + n, None]
        strengths += [unit * d for d in direction]
        start += n
    return _local(T, at, T.action_sum(*strengths))


def _wrenches(residual: _Residual, T: Any, loads: Tensor) -> Tensor:
    """Forces and moments on the mounts of a body [columns, 6 mounts] of loads on vectors [columns, vectors, 3]."""
    x, mounts = residual.body.mesh.nodes - residual.body.origin, residual.mounts
    found = loads.new_zeros(len(loads), len(mounts), 6)
    for i in range(T.attached_flexible):
        attached: Attached = T.attached[i]
        if int(T.vector_flexible[i]) != residual.number or attached.interpolation not in mounts:
            continue
        k, force = mounts.index(attached.interpolation), loads[:, i]
        lever = attached.vector
        if attached.is_point:
            lever = lever - attached.interpolation.center(x)
            found[:, k, :3] += force
        found[:, k, 3:] += torch.linalg.cross(lever.expand_as(force), force)
    return found.flatten(1)


def _of_forces(residual: _Residual, T: Any, loads: Tensor) -> StaticTruncation | None:
    """Of the forces on a body: each beside the most flexible direction of its frame."""
    shares = []
    for w in _wrenches(residual, T, loads):
        if not bool(w.any()):
            continue
        parts = w.reshape(-1, 6)
        kind = slice(0, 3) if bool(parts[:, :3].any()) else slice(3, 6)
        k = int(parts[:, kind].norm(dim=1).argmax())
        rows = torch.arange(6 * k, 6 * k + 6)[kind]
        f = parts[k, kind]
        most = torch.linalg.eigvalsh(residual.G[rows][:, rows])[-1]
        shares.append((float(f @ residual.R[rows][:, rows] @ f / (f @ f * most)), k))
    if not shares:
        return None
    share, k = max(shares)
    return StaticTruncation(share, None, *_said(residual, k))


def _of_joints(residuals: list[_Residual], T: Any, rest: Linearization, loads: Tensor) -> StaticTruncation | None:
    """Of the lowest elastic vibrations of the system."""
    W = [_wrenches(residual, T, loads) for residual in residuals]
    C = torch.stack([w @ x.R @ w.T for w, x in zip(W, residuals, strict=True)]).sum(0)
    looked_at = _elastic(T, rest)
    if not bool(C.any()) or not looked_at:
        return None
    before = Vibrations.of(rest).frequencies[looked_at]
    squares, multipliers = _softer(rest, C, (2.0 * math.pi * _SHIFT * float(before[0])) ** 2)
    after = squares[looked_at].clamp_min(0.0).sqrt() / (2.0 * math.pi)
    shares = 1.0 - (after / before).square()
    worst = int(shares.argmax())
    lam = multipliers[:, looked_at[worst]]
    parts = [(w.T @ lam) * (x.R @ (w.T @ lam)) for w, x in zip(W, residuals, strict=True)]
    energies = [part.reshape(-1, 6).sum(1) for part in parts]
    k = max(range(len(parts)), key=lambda k: float(energies[k].sum()))
    said = _said(residuals[k], int(energies[k].argmax()))
    return StaticTruncation(float(shares[worst]), (float(before[worst]), float(after[worst])), *said)


def _elastic(T: Any, rest: Linearization) -> list[int]:
    """The first vibration whose energy is in modal coordinates, for a good part, and those near it."""
    found = Vibrations.of(rest)
    w = found.shapes[6 * T.bodies :]
    energy = (w * (rest.K[6 * T.bodies :, 6 * T.bodies :] @ w)).sum(0)
    elastic = energy > _ELASTIC * (2.0 * math.pi * found.frequencies).square()
    elastic &= found.frequencies > _RIGID * found.frequencies.nan_to_num(0.0).max()
    first = elastic.nonzero()[:1, 0]
    return (elastic & (found.frequencies <= _NEAR * found.frequencies[first].sum())).nonzero()[:, 0].tolist()


def _softer(rest: Linearization, C: Tensor, rigid: float) -> tuple[Tensor, Tensor]:
    """Squares of angular frequencies, rising, and multipliers [rows, n] of vibrations with flexibility C in the joints.

    rigid: square of an angular frequency below those that count, which makes the stiffness regular
    """
    own, J = rest.active, rest.Phi_q[:, rest.active]
    K, M = (0.5 * (x + x.T) for x in (rest.K[own][:, own], rest.M[own][:, own]))
    shift = rigid + 2.0 * max(0.0, -float(_squares(rest.reduced(rest.K), rest.reduced(rest.M))[0]))
    small = _REGULAR * C.diagonal().max() * torch.eye(len(C), dtype=C.dtype)
    saddle = torch.cat([torch.cat([K + shift * M, J.T], 1), torch.cat([J, -C - small], 1)])
    inverse = torch.linalg.inv(saddle)[:, : len(M)]
    masses, axes = torch.linalg.eigh(M)
    L = axes * masses.clamp_min(0.0).sqrt()
    B = L.T @ inverse[: len(M)] @ L
    values, Y = torch.linalg.eigh(0.5 * (B + B.T))
    values, Y = values.flip(0), Y.flip(1)
    return 1.0 / values.clamp_min(1e-300) - shift, inverse[len(M) :] @ (L @ Y)


def _squares(K: Tensor, M: Tensor) -> Tensor:
    """Eigenvalues of K x = s M x, rising."""
    inverse = torch.linalg.inv(torch.linalg.cholesky(0.5 * (M + M.T)))
    return torch.linalg.eigvalsh(inverse @ (0.5 * (K + K.T)) @ inverse.T)


def _said(residual: _Residual, k: int) -> tuple[str, str, str]:
    """Body, frame and advice."""
    mesh = residual.body.mesh
    names = [_named(mesh, mount) for mount in residual.mounts]
    kept = [f"mbd.Interface({n})" if len(m.nodes) > 1 else n for n, m in zip(names, residual.mounts, strict=True)]
    advice = f'reduction="craig-bampton" with interface=[{", ".join(dict.fromkeys(kept))}], or more modes'
    return residual.body.name, names[k], advice


def _named(mesh: Any, mount: InterpolationConstraint) -> str:
    """What the caller of `body.at` calls the nodes."""
    for name, members in mesh.node_sets.items():
        if sorted(int(i) for i in members) == sorted(mount.nodes):
            return repr(name)
    nodes = ", ".join(map(str, mount.nodes[:_SHOWN]))
    return nodes if len(mount.nodes) == 1 else f"[{nodes}{', ...' * (len(mount.nodes) > _SHOWN)}]"
