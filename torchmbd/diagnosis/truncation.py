"""Static truncation: flexibility that the retained modes of flexible bodies lack at joints and forces.

    R = F' K^-1 F - (Psi' F)' Kr^-1 (Psi' F)          residual flexibility under unit loads F at the frames of a body
    C = sum over bodies W' R W                        W: loads on its frames of unit multipliers

    M x'' + K x + Phi_q' lam = 0,  Phi_q x = C lam    vibrations with the residual flexibility in the joints

    joints   1 - (f / f0)^2 of the first elastic vibration of the system, and those up to twice as fast; f0 without C, f with it
    forces   w'R w beside the largest w'G w of forces (or moments) at the same frame, G = F' K^-1 F
    changes  R beside G of the loads F of a change of temperature or moisture

Of the present design at its initial position, drives held. Residual masses are left out. Bodies that were reduced elsewhere
have no K, and no residual flexibility.
Source: MacNeal, Comput. Struct. 1 (1971) 581-601 (residual flexibility).
Checked in tests/diagnosis/test_truncation.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import MbdError, warn
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.module_call import exclusive, outside_transforms
from torchmbd.multibody.bodies.expansion import zone_list
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equilibrium.linearized import Linearization, Vibrations
from torchmbd.multibody.forces.temperature import ExpansionVector
from torchmbd.multibody.joints.joint import Attached
from torchmbd.multibody.system import System

_NEAR = 2.0  # times the first elastic frequency: the highest frequency of a vibration that is compared
LARGEST = 300  # most rates of a system whose vibrations are compared, as the methods are dense
_REGULAR = 1e-12  # share of the largest flexibility in the joints that is added, so that redundant rows are determined
_SHOWN = 4  # nodes in a message
_ELASTIC = 0.2  # least share of the energy of a vibration in the modal coordinates that makes it elastic
_RIGID = 1e-5  # share of the highest frequency of a mode alone: below it, a vibration has no stiffness
_SHIFT = 1e-2  # share of the first elastic frequency: a stiffness that makes these freedoms regular


@dataclass(frozen=True)
class StaticTruncation:
    """The largest effect of static truncation in one system.

    share         of the stiffness of a vibration that is too much, or of the deflection under a force that is missing, 0 to 1
    frequencies   of the vibration without and with the residual flexibility [Hz]; None: the share is that of a deflection
    body, where   the body with the largest part of the residual flexibility, and its frame
    advice        a setting without this truncation
    load          the load, of a deflection: a force, or a change of temperature or moisture
    rigid         True if the joints hold all modes of all bodies, so that no elastic vibration is left; the share is 1
    """

    share: float
    frequencies: tuple[float, float] | None
    body: str
    where: str
    advice: str
    load: str = "a force at"
    rigid: bool = False

    def __str__(self) -> str:
        what = f"{100 * self.share:.2g} % of the deflection of body {self.body!r} under {self.load} {self.where}"
        if self.rigid:
            what = f"all flexibility of body {self.body!r}: joints, such as at {self.where}, hold all its modes, so it is rigid"
        elif self.frequencies is not None:
            with_modes, exact = self.frequencies
            what = (
                f"flexibility of body {self.body!r} at {self.where}, so a vibration has {with_modes:.3g} Hz instead of "
                f"{exact:.3g} Hz"
            )
        return f"the retained modes leave out {what}; better: {self.advice}"


@dataclass(frozen=True)
class _Residual:
    """Residual flexibility of one body.

    number   of the body among the flexible bodies
    mounts   node sets of its frames, without those of its reference
    G, R     flexibility and residual flexibility under unit forces and moments at these [6 mounts, 6 mounts]
    """

    body: Any
    number: int
    mounts: list[InterpolationConstraint]
    G: Tensor
    R: Tensor


@exclusive
def static_truncation(system: System) -> StaticTruncation | None:
    """Find the largest flexibility that the retained modes leave out at joints and forces, in the present design of a system.

    None if no joint and no force acts on a flexible body of known stiffness.

    >>> found = mbd.static_truncation(mbd.examples.arm())
    >>> found.share < 0.02, found.body  # of the stiffness in the first vibrations
    (True, 'arm')
    """
    if not system.topology.attached_flexible:
        return None
    dynamics, stages = system.stages({})
    dynamics = dynamics.values().select_lanes([0])
    T = dynamics.topology  # of the modes that the present design has
    with torch.no_grad():
        residuals = [x for x in (_residual(system, dynamics, stages, k) for k in range(T.flexible)) if x is not None]
        q, v = dynamics.start
        t = q.new_zeros(())
        at = equations.placement(T, dynamics.data, q, T.prescribed(t, dynamics.data))
        truncations = [_of_forces(residual, T, _action_loads(dynamics, at, v)) for residual in residuals if T.actions]
        truncations += [
            _of_changes(system, dynamics, stages, i) for i, x in enumerate(T.attached) if isinstance(x, ExpansionVector)
        ]
        if T.rows and T.n_v <= LARGEST and residuals:
            loads = _local(T, at, equations.force_on_vectors(T, at, torch.eye(T.rows, dtype=q.dtype)[:, None]))
            rest = Linearization.of(dynamics, q[:, 0, 0], t, released=True)
            truncations.append(_of_joints(residuals, T, rest, loads))
    return max((x for x in truncations if x is not None), key=lambda x: x.share, default=None)


def warn_static_truncation(system: System) -> None:
    """Warn where the share exceeds `system.truncation`; each system is checked once: its joints and forces decide, too."""
    if system.truncation is None or "truncation" in system.diagnosed:
        return
    system.diagnosed["truncation"] = True
    try:
        truncation = outside_transforms(lambda: static_truncation(system))
    except (MbdError, torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
        return  # the designs to be simulated need not have the errors of the present one
    if truncation is not None and truncation.share > system.truncation:
        warn(f"{truncation}. mbd.System(..., truncation=None) switches this warning off")


def _residual(system: Any, dynamics: Any, stages: dict[str, Tensor], k: int) -> _Residual | None:
    """The residual flexibility of flexible body k; None without a known stiffness, or frames beside the reference."""
    T = dynamics.topology
    body, n = system.body(T.names[k]), T.mode_counts[k]
    flexibility = body.flexibility()
    attached = [T.attached[i] for i in range(T.attached_flexible) if int(T.vector_flexible[i]) == k]
    mounts = [x.interpolation for x in attached if x.interpolation is not None]
    mounts = [mount for mount in dict.fromkeys(mounts) if not set(mount.nodes) <= set(body.reference)]
    if flexibility is None or not mounts:
        return None
    K, expand = flexibility
    x = body.mesh.nodes - body.origin
    F = _unit_loads(x, mounts, expand, K.size)
    G = F.T @ StaticLoads(K.pattern)(K, F)
    psi = stages[body.name].detach()
    moved = torch.cat([mount.motion(x, psi.reshape(-1, *psi.shape[-3:])[0]) for mount in mounts])  # [6 mounts, modes]
    R = G - moved @ torch.linalg.solve(dynamics.data["Kr"][:n, :n, k, 0, 0], moved.T)
    return _Residual(body, k, mounts, 0.5 * (G + G.T), 0.5 * (R + R.T))


def _of_changes(system: Any, dynamics: Any, stages: dict[str, Tensor], i: int) -> StaticTruncation | None:
    """Truncation under the change of attached vector i; None where it loads nothing."""
    T, vector = dynamics.topology, dynamics.topology.attached[i]
    k = int(T.vector_flexible[i])
    body, n = system.body(T.names[k]), T.mode_counts[k]
    nodal = body.expansion.forces(vector.zone, vector.change)
    nodal = nodal.reshape(-1, *nodal.shape[-2:])[0]
    K, _ = body.flexibility()
    F = body.assembly.freedoms.gathered(nodal[..., None])
    G = float((F.T @ StaticLoads(K.pattern)(K, F)).squeeze())
    psi = stages[body.name].detach()
    work = torch.einsum("ni,nim->m", nodal, psi.reshape(-1, *psi.shape[-3:])[0])
    R = G - float(work @ torch.linalg.solve(dynamics.data["Kr"][:n, :n, k, 0, 0], work))
    if not G > 0.0:
        return None
    of = f" of part {vector.zone!r}" if vector.zone else ""
    zones = list(dict.fromkeys([*zone_list(body.expansion_zones), vector.zone or True]))
    advice = f"expansion={(zones[0] if len(zones) == 1 else zones)!r} of the body"
    return StaticTruncation(R / G, None, body.name, f"{vector.change}{of}", advice, "a change of")


def _unit_loads(x: Tensor, mounts: Sequence[InterpolationConstraint], expand: Any, size: int) -> Tensor:
    """Nodal loads [size, 6 mounts] of unit forces and moments at the mounts: the transpose of their motion."""
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
    """Forces on vectors, in axes of flexible bodies, of unit strengths of the actions [actions, vectors, 3]."""
    T = dynamics.topology
    count, start, strengths = sum(len(action.members[0]) for action in T.actions), 0, []
    for action, (_, _, direction) in zip(T.actions, equations.action_states(T, dynamics.data, at, v), strict=True):
        n = len(action.members[0])
        unit = torch.eye(count, dtype=v.dtype)[start : start + n, None]
        strengths += [unit * d for d in direction]
        start += n
    return _local(T, at, T.action_sum(*strengths))


def _wrenches(residual: _Residual, T: Any, loads: Tensor) -> Tensor:
    """Forces and moments on the mounts of a body [columns, 6 mounts], out of forces on vectors [columns, vectors, 3]."""
    x, mounts = residual.body.mesh.nodes - residual.body.origin, residual.mounts
    wrenches = loads.new_zeros(len(loads), len(mounts), 6)
    for i in range(T.attached_flexible):
        attached: Attached = T.attached[i]
        if int(T.vector_flexible[i]) != residual.number or attached.interpolation not in mounts:
            continue
        k, force = mounts.index(attached.interpolation), loads[:, i]
        lever = attached.vector
        if attached.is_point:
            lever = lever - attached.interpolation.center(x)
            wrenches[:, k, :3] += force
        wrenches[:, k, 3:] += torch.linalg.cross(lever.expand_as(force), force)
    return wrenches.flatten(1)


def _of_forces(residual: _Residual, T: Any, loads: Tensor) -> StaticTruncation | None:
    """Truncation under the forces on a body, each compared with the flexibility of its frame in the most flexible direction."""
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
    return StaticTruncation(share, None, *_texts(residual, k))


def _of_joints(residuals: list[_Residual], T: Any, rest: Linearization, loads: Tensor) -> StaticTruncation | None:
    """Truncation in the lowest elastic vibrations of the system."""
    W = [_wrenches(residual, T, loads) for residual in residuals]
    C = torch.stack([w @ x.R @ w.T for w, x in zip(W, residuals, strict=True)]).sum(0)
    vibrations = Vibrations.of(rest)
    elastic = _elastic(T, rest, vibrations)
    if not bool(C.any()):
        return None
    if not elastic:
        parts = [torch.einsum("ij,jk,ik->ij", w, x.R, w) for w, x in zip(W, residuals, strict=True)]
        k = max(range(len(parts)), key=lambda k: float(parts[k].sum()))
        mounts = parts[k].sum(0).reshape(-1, 6).sum(1)
        return StaticTruncation(1.0, None, *_texts(residuals[k], int(mounts.argmax())), rigid=True)
    before = vibrations.frequencies[elastic]
    squares, multipliers = _flexible_joints(rest, C, (2.0 * math.pi * _SHIFT * float(before[0])) ** 2)
    after = squares[elastic].clamp_min(0.0).sqrt() / (2.0 * math.pi)
    shares = 1.0 - (after / before).square()
    worst = int(shares.argmax())
    lam = multipliers[:, elastic[worst]]
    parts = [(w.T @ lam) * (x.R @ (w.T @ lam)) for w, x in zip(W, residuals, strict=True)]
    energies = [part.reshape(-1, 6).sum(1) for part in parts]
    k = max(range(len(parts)), key=lambda k: float(energies[k].sum()))
    texts = _texts(residuals[k], int(energies[k].argmax()))
    return StaticTruncation(float(shares[worst]), (float(before[worst]), float(after[worst])), *texts)


def _elastic(T: Any, rest: Linearization, vibrations: Vibrations) -> list[int]:
    """Numbers of the first elastic vibration and of those up to twice as fast; elastic: with energy in modal coordinates."""
    frequencies, w = vibrations.frequencies, vibrations.shapes[6 * T.bodies :]
    if not len(frequencies):  # the joints leave no motion
        return []
    energy = (w * (rest.K[6 * T.bodies :, 6 * T.bodies :] @ w)).sum(0)
    elastic = energy > _ELASTIC * (2.0 * math.pi * frequencies).square()
    modal = (rest.K.diagonal() / rest.M.diagonal())[6 * T.bodies :]
    elastic &= frequencies > _RIGID * float(modal.max().sqrt()) / (2.0 * math.pi)
    first = elastic.nonzero()[:1, 0]
    return (elastic & (frequencies <= _NEAR * frequencies[first].sum())).nonzero()[:, 0].tolist()


def _flexible_joints(rest: Linearization, C: Tensor, small: float) -> tuple[Tensor, Tensor]:
    """Squares of angular frequencies, ascending, and multipliers [rows, n] of vibrations with flexibility C in the joints.

    small   square of an angular frequency below all elastic ones: a shift that makes the stiffness regular
    """
    s, size = rest.scale[rest.active], rest.row_sizes
    J, C = rest.Phi_q[:, rest.active] * s / size[:, None], C / size / size[:, None]
    K, M = (
        0.5 * s[:, None] * (x + x.T) * s
        for x in (rest.K[rest.active][:, rest.active], rest.M[rest.active][:, rest.active])
    )
    shift = small + 2.0 * max(0.0, -float(_squares(rest.reduced(rest.K), rest.reduced(rest.M))[0]))
    regular = _REGULAR * C.diagonal().max() * torch.eye(len(C), dtype=C.dtype)
    saddle = torch.cat([torch.cat([K + shift * M, J.T], 1), torch.cat([J, -C - regular], 1)])
    inverse = torch.linalg.inv(saddle)[:, : len(M)]
    masses, axes = torch.linalg.eigh(M)
    L = axes * masses.clamp_min(0.0).sqrt()
    B = L.T @ inverse[: len(M)] @ L
    values, Y = torch.linalg.eigh(0.5 * (B + B.T))
    values, Y = values.flip(0), Y.flip(1)
    return 1.0 / values.clamp_min(1e-300) - shift, (inverse[len(M) :] @ (L @ Y)) / size[:, None]


def _squares(K: Tensor, M: Tensor) -> Tensor:
    """Eigenvalues s of K x = s M x, ascending."""
    inverse = torch.linalg.inv(torch.linalg.cholesky(0.5 * (M + M.T)))
    return torch.linalg.eigvalsh(inverse @ (0.5 * (K + K.T)) @ inverse.T)


def _texts(residual: _Residual, k: int) -> tuple[str, str, str]:
    """`body`, `where` and `advice` of StaticTruncation for mount k."""
    mesh = residual.body.mesh
    names = [_named(mesh, mount) for mount in residual.mounts]
    interfaces = [f"mbd.Interface({n})" if len(m.nodes) > 1 else n for n, m in zip(names, residual.mounts, strict=True)]
    advice = f'reduction="craig-bampton" with interface=[{", ".join(dict.fromkeys(interfaces))}], or more modes'
    return residual.body.name, names[k], advice


def _named(mesh: Any, mount: InterpolationConstraint) -> str:
    """The argument of `body.at` for a mount: the name of its node set, or its nodes."""
    for name, members in mesh.node_sets.items():
        if sorted(int(i) for i in members) == sorted(mount.nodes):
            return repr(name)
    nodes = ", ".join(map(str, mount.nodes[:_SHOWN]))
    return nodes if len(mount.nodes) == 1 else f"[{nodes}{', ...' * (len(mount.nodes) > _SHOWN)}]"
