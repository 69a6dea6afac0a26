"""Beam elements between frames of rigid bodies: their forces by the relative screws of the frames, and their stiffness.

    l = log(H_1^-1 H_2),    f = K (l - l_0 + d l'),    work: f' dl      (math/screw.py)

H_1, H_2   the frames: points that are attached vectors, axes `beam_start`, `beam_end` in the axes of their bodies

Rotations of any size; a rigid motion of both frames does not change l. The stiffness is exact: forces turn with their frames,
and change with the screw.
Data: beam_stiffness [6, 6, n], beam_rest l_0 [6, n], beam_start, beam_end [3, 3, n], and beam_damping d [n] where there is any.
Checked in tests/multibody/equations/test_beams.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.math.pair import cat, cross, dot, matmul, matvec, matvec_t
from torchmbd.math.rotation import increment_torque, skew
from torchmbd.math.screw import rate_slopes, screw, screw_rate, wrench_slopes, wrenches
from torchmbd.multibody.equations.index_maps import SegmentSum

SHAPES = {"beam_stiffness": (6, 6), "beam_rest": (6,), "beam_start": (3, 3), "beam_end": (3, 3), "beam_damping": ()}


@dataclass(frozen=True, eq=False)
class Beams:
    """Index tensors of n beam elements.

    ends      attached points [2 n] of all starts, then of all ends
    bodies    body of each of these
    body_sum  sums of [forces | torques] at these points by bodies
    """

    ends: Tensor
    bodies: list[int]
    body_sum: SegmentSum

    @classmethod
    def of(cls, ends: Sequence[int], body_of: Sequence[int], moving: int) -> Beams:
        """body_of: body of each attached vector; moving: number of bodies, before the known ones."""
        bodies = [body_of[i] for i in ends]
        groups = [b if b < moving else -1 for b in bodies] + [moving + b if b < moving else -1 for b in bodies]
        return cls(torch.tensor(ends, dtype=torch.long), bodies, SegmentSum(groups, 2 * moving))

    def select(self, x: Any, dim: int) -> tuple[Any, Any]:
        """Entries of x, along the axis `dim` of attached vectors, at starts and at ends."""
        n = len(self.ends) // 2
        return x.index_select(dim, self.ends[:n]), x.index_select(dim, self.ends[n:])


def beam_data(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Data [component..., n, 1, lanes] of all elements, out of those of the force elements [*lanes, m, ...]."""
    data = {}
    for name, core in SHAPES.items():
        if not any(name in part for part in parts):
            continue
        arrays = [
            part[name] if name in part else torch.zeros(part["beam_rest"].shape[-2], dtype=torch.float64)
            for part in parts
        ]
        k = 1 + len(core)
        lanes = np.broadcast_shapes(*(x.shape[:-k] for x in arrays))
        x = torch.cat([x.expand(*lanes, *x.shape[-k:]) for x in arrays], -k)
        x = x.reshape(-1, *x.shape[-k:]).movedim(1, -1)  # [lanes, *core, n]
        data[name] = x.movedim(0, -1).unsqueeze(-2)
    return data


class Elements(NamedTuple):
    """Beam elements at one position; pairs are of starts and ends.

    turn, arm           axes of the frames [3, 3, n] and their points [3, n] in body axes
    A                   rotations of their bodies [3, 3, n]
    screw, force        l and f [6, n, ...]
    With dampers also:
    rate                l' [6, n, ...]
    frame_velocities    velocities and angular velocities of the frames [6, n, ...] in their own axes
    origin_velocities   velocities of the origins of the bodies [3, n, ...] in body axes
    """

    turn: tuple[Any, Any]
    arm: tuple[Any, Any]
    A: tuple[Any, Any]
    screw: Any
    force: Any
    rate: Any = None
    frame_velocities: Any = None
    origin_velocities: Any = None


def elements(T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None = None) -> Elements:
    """The elements at a placement.

    rates   velocities in ground axes and angular velocities in body axes of all attached vectors [3, vectors, ...]
    """
    A, arm, point = T.beams.select(at.A_of, 2), T.beams.select(at.rho, 1), T.beams.select(at.g, 1)
    turn = data["beam_start"], data["beam_end"]
    axes = matmul(A[0], turn[0]), matmul(A[1], turn[1])
    l = screw(matvec_t(axes[0], point[1] - point[0]), matmul(axes[0].transpose(0, 1), axes[1]))
    strain, rate, of_frames, of_origins = l - data["beam_rest"], None, None, None
    if rates is not None and "beam_damping" in data:
        velocity, spin = (T.beams.select(x, 1) for x in rates)
        of_frames = [cat([matvec_t(axes[k], velocity[k]), matvec_t(turn[k], spin[k])]) for k in range(2)]
        of_origins = [matvec_t(A[k], velocity[k]) - cross(spin[k], arm[k]) for k in range(2)]
        rate = screw_rate(l, of_frames[0], of_frames[1])
        strain = strain + data["beam_damping"] * rate
    return Elements(turn, arm, A, l, matvec(data["beam_stiffness"], strain), rate, of_frames, of_origins)


def resistance(T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None) -> tuple[Any, Any]:
    """Forces [3, bodies] in ground axes and torques [3, bodies] in body axes with which the elements resist their strains."""
    return on_bodies(T, elements(T, data, at, rates))


def on_bodies(T: Any, e: Elements) -> tuple[Any, Any]:
    """The forces of elements as `resistance` has them."""
    forces, torques = [], []
    for k, w in enumerate(wrenches(e.screw, e.force)):
        force = matvec(e.turn[k], w[:3])
        forces.append(matvec(e.A[k], force))
        torques.append(matvec(e.turn[k], w[3:]) + cross(e.arm[k], force))
    both = T.beams.body_sum(*forces, *torques)
    return both[:, : T.bodies], both[:, T.bodies :]


def stiffness(
    T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None, factor: Any, rate_factor: Any, turn: Any = None
) -> Any:
    """`factor` times the derivatives of `resistance` by displacements in ground axes and rotations in body axes of the bodies
    of both ends, plus `rate_factor` times those by their rates: [12, 12, n, ...].

    turn   rotation vectors [3, vectors, ...] of a step, for the bodies of attached vectors: derivatives are then by these
    """
    e = elements(T, data, at, rates)
    eye = torch.eye(6, dtype=torch.float64)[:, :, None, None, None]
    unit = eye + 0.0 * data["beam_rest"]
    unit_wrenches = wrenches(e.screw.unsqueeze(1), unit)
    C = _on_bodies(e, unit_wrenches)  # also the transpose of the derivative of the screws by the bodies
    S = _on_bodies(e, wrench_slopes(e.screw, e.force))
    CK = matmul(C, data["beam_stiffness"])
    K = factor * (matmul(CK + S, C.transpose(0, 1)) + _rotation_of_forces(e))
    if "beam_damping" not in data:
        return _by_increment(T, K, turn)
    CD = data["beam_damping"] * CK
    K = K + factor * matmul(CD, _screw_rate_slopes(e, unit_wrenches, C))
    return _by_increment(T, K, turn) + rate_factor * matmul(CD, C.transpose(0, 1))


def _screw_rate_slopes(e: Elements, unit_wrenches: tuple[Any, Any], C: Any) -> Any:
    """Derivatives of the screws' rates by displacements and rotations of the bodies at fixed rates [6, 12, n, ...]."""
    by_screw = matmul(rate_slopes(e.screw, *e.frame_velocities), C.transpose(0, 1))
    parts = []
    for k in range(2):
        velocity_slopes = matmul(e.turn[k].transpose(0, 1), skew(e.origin_velocities[k]))  # in axes that turn
        by_turn = matmul(unit_wrenches[k][:3].transpose(0, 1), velocity_slopes)
        parts += [by_turn * 0.0, by_turn]
    return by_screw + cat(parts, 1)


def _by_increment(T: Any, K: Any, turn: Any) -> Any:
    """K [12, 12, n, ...] by the rotation vectors of a step."""
    if turn is None:
        return K
    turns, rows = T.beams.select(turn, 1), K.transpose(0, 1)
    parts = []
    for k in range(2):
        slopes = rows[6 * k + 3 : 6 * k + 6]
        parts += [rows[6 * k : 6 * k + 3], increment_torque(turns[k].unsqueeze(1), slopes)]
    return cat(parts).transpose(0, 1)


def _on_bodies(e: Elements, ends: tuple[Any, Any]) -> Any:
    """Wrenches [6, k, n, ...] in the axes of both frames as forces in ground axes and torques in body axes [12, k, n, ...]."""
    parts = []
    for k, w in enumerate(ends):
        force = matmul(e.turn[k], w[:3])
        parts += [matmul(e.A[k], force), matmul(e.turn[k], w[3:]) + matmul(skew(e.arm[k]), force)]
    return cat(parts)


def _rotation_of_forces(e: Elements) -> Any:
    """Derivatives of forces in ground axes by the rotations of their bodies, with which they turn [12, 12, n, ...]."""
    rows = []
    for k, w in enumerate(wrenches(e.screw, e.force)):
        by_turn = -matmul(e.A[k], skew(matvec(e.turn[k], w[:3])))
        o = by_turn * 0.0
        wide = cat([o, o], 1)
        rows += [cat([o, by_turn, wide] if k == 0 else [wide, o, by_turn], 1), cat([wide, wide], 1)]
    return cat(rows)


def matrix_entries(T: Any, block: np.ndarray) -> np.ndarray:
    """Row and column in the matrix of all rates, and entry number, of each entry of the block [12, 12, n]: [3, entries].

    block   entry numbers (saddle.entry_numbers) of `stiffness`
    """
    n, count = T.bodies, block.shape[-1]
    body = np.array(T.beams.bodies).reshape(2, count)
    rate = np.concatenate([np.arange(6)[:, None] * n + b for b in body])  # [12, n]
    moving = np.repeat(body < n, 6, 0)
    both = moving[:, None] & moving[None]
    row, column = np.broadcast_arrays(rate[:, None], rate[None])
    return np.stack([row[both], column[both], block[both]])


def stored_energy(T: Any, data: Any, at: Any) -> Any:
    """Strain energy of all elements [1, ...]."""
    e = elements(T, data, at)
    return 0.5 * dot(e.screw - data["beam_rest"], e.force).sum(0)


def dissipation(T: Any, data: Any, at: Any, rates: tuple[Any, Any]) -> Any:
    """Power that the dampers of all elements dissipate [1, ...]."""
    rate = elements(T, data, at, rates).rate
    return (data["beam_damping"] * dot(rate, matvec(data["beam_stiffness"], rate))).sum(0)
