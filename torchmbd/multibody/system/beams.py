"""Elements of beams between frames of rigid bodies: forces of their relative screws, and what these add to the matrix.

    l = log(H_1^-1 H_2),    f = K (l - l_0 + d l'),    work: f' dl      (math/screw.py)

H_1, H_2   the frames: points that are attached vectors, axes `beam_start`, `beam_end` in the axes of their bodies

Rotations of any size; a rigid motion of both frames leaves l as it is. In the matrix everything counts: also that forces
turn with their frames and change with the screw.
Data: beam_stiffness [6, 6, n], beam_rest [6, n], beam_start, beam_end [3, 3, n], beam_damping d [n] where there is any.
Checked in tests/multibody/system/test_beams.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.math.pair import cat, cross, dot, matmul, matvec, matvec_t
from torchmbd.math.rotation import skew
from torchmbd.math.screw import rate_slopes, screw, screw_rate, wrench_slopes, wrenches
from torchmbd.multibody.system.index_maps import SegmentSum

SHAPES = {"beam_stiffness": (6, 6), "beam_rest": (6,), "beam_start": (3, 3), "beam_end": (3, 3), "beam_damping": ()}


@dataclass(frozen=True, eq=False)
class Beams:
    """Index tensors. ends: attached points, of all starts, then of all ends [2 n]; sum: of a topology's bodies."""

    ends: Tensor
    bodies: list[int]  # of the ends
    sum: Any

    @classmethod
    def of(cls, ends: Sequence[int], body_of: Sequence[int], n: int) -> Beams:
        """Of the attached points of all starts, then of all ends; body_of: of all attached vectors; n bodies move."""
        on = [body_of[i] for i in ends]
        groups = [b if b < n else -1 for b in on] + [n + b if b < n else -1 for b in on]
        return cls(torch.tensor(ends, dtype=torch.long), on, SegmentSum(groups, 2 * n))

    def pick(self, x: Any, dim: int) -> tuple[Any, Any]:
        """Entries of attached vectors at starts and at ends."""
        n = len(self.ends) // 2
        return x.index_select(dim, self.ends[:n]), x.index_select(dim, self.ends[n:])


def beam_data(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Data of all elements out of those of each force [*lanes, m, ...]; beam_damping where it has any."""
    found = {}
    for name, core in SHAPES.items():
        if not any(name in part for part in parts):
            continue
        own = [part[name] if name in part else torch.zeros(part["beam_rest"].shape[-2]).double() for part in parts]
        k = 1 + len(core)
        lanes = torch.broadcast_shapes(*(x.shape[:-k] for x in own))
        x = torch.cat([x.expand(*lanes, *x.shape[-k:]) for x in own], -k)
        x = x.reshape(-1, *x.shape[-k:]).movedim(1, -1)  # [lanes, *core, n]
        found[name] = x.movedim(0, -1).unsqueeze(-2)
    return found


class Elements(NamedTuple):
    """The elements at a position: axes of the frames in space and in their bodies, arms, screws, forces f; and with dampers
    the rates of the screws, the velocities [6, n, ...] of both frames in their own axes and of the points in body axes."""

    axes: tuple[Any, Any]
    turn: tuple[Any, Any]
    arm: tuple[Any, Any]
    A: tuple[Any, Any]
    screw: Any
    force: Any
    rate: Any = None
    ends: Any = None
    carried: Any = None


def elements(T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None = None) -> Elements:
    """At a placement; rates: velocities in ground axes and angular velocities in body axes of all attached vectors."""
    A, arm, place = T.beams.pick(at.A_of, 2), T.beams.pick(at.rho, 1), T.beams.pick(at.g, 1)
    turn = data["beam_start"], data["beam_end"]
    axes = matmul(A[0], turn[0]), matmul(A[1], turn[1])
    l = screw(matvec_t(axes[0], place[1] - place[0]), matmul(axes[0].transpose(0, 1), axes[1]))
    strain, rate, ends, carried = l - data["beam_rest"], None, None, None
    if rates is not None and "beam_damping" in data:
        velocity, spin = (T.beams.pick(x, 1) for x in rates)
        ends = [cat([matvec_t(axes[k], velocity[k]), matvec_t(turn[k], spin[k])]) for k in range(2)]
        carried = [matvec_t(A[k], velocity[k]) - cross(spin[k], arm[k]) for k in range(2)]  # the bodies' origins
        rate = screw_rate(l, ends[0], ends[1])
        strain = strain + data["beam_damping"] * rate
    return Elements(axes, turn, arm, A, l, matvec(data["beam_stiffness"], strain), rate, ends, carried)


def resistance(T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None) -> tuple[Any, Any]:
    """Forces [3, bodies] in ground axes and torques [3, bodies] in body axes with which the elements resist their strains."""
    e = elements(T, data, at, rates)
    forces, torques = [], []
    for k, w in enumerate(wrenches(e.screw, e.force)):
        own = matvec(e.turn[k], w[:3])
        forces.append(matvec(e.A[k], own))
        torques.append(matvec(e.turn[k], w[3:]) + cross(e.arm[k], own))
    both = T.beams.sum(*forces, *torques)
    return both[:, : T.bodies], both[:, T.bodies :]


def stiffness(
    T: Any, data: Any, at: Any, rates: tuple[Any, Any] | None, by_place: Any, by_rate: Any, turn: Any = None
) -> Any:
    """by_place times the derivatives of `resistance` by small displacements in ground axes and rotations in body axes of
    the bodies of both ends, and by_rate times those by their rates: [12, 12, n, ...].

    turn   rotations [3, vectors, ...] of the bodies of attached vectors in a step: derivatives are then by these
    """
    e = elements(T, data, at, rates)
    eye = torch.eye(6, dtype=torch.float64)[:, :, None, None, None]
    unit = eye + 0.0 * data["beam_rest"]
    back = wrenches(e.screw.unsqueeze(1), unit)
    C = _on_bodies(e, back)
    S = _on_bodies(e, wrench_slopes(e.screw, e.force))
    pull = matmul(C, data["beam_stiffness"])
    by_screw = by_place * (pull + S)
    found = matmul(by_screw, C.transpose(0, 1)) + by_place * _turning(e)
    if "beam_damping" not in data:
        return _by_increment(T, found, turn)
    damped = data["beam_damping"] * pull
    found = found + by_place * matmul(damped, _rate_by_place(e, back, C))
    return _by_increment(T, found, turn) + by_rate * matmul(damped, C.transpose(0, 1))


def _rate_by_place(e: Elements, back: tuple[Any, Any], C: Any) -> Any:
    """Derivatives of the screws' rates by the bodies' places, their rates held [6, 12, n, ...]."""
    by_screw = matmul(rate_slopes(e.screw, *e.ends), C.transpose(0, 1))
    parts = []
    for k in range(2):
        own = matmul(e.turn[k].transpose(0, 1), skew(e.carried[k]))  # velocities in axes that turn
        by_turn = matmul(back[k][:3].transpose(0, 1), own)
        parts += [by_turn * 0.0, by_turn]
    return by_screw + cat(parts, 1)


def _by_increment(T: Any, K: Any, turn: Any) -> Any:
    """K [12, 12, n, ...] by changes of the rotations of a step: a change d turns a body by (1 - ~th/2 + ~th~th/6) d."""
    if turn is None:
        return K
    th, rows = T.beams.pick(turn, 1), K.transpose(0, 1)
    parts = []
    for k in range(2):
        own, half = rows[6 * k + 3 : 6 * k + 6], th[k].unsqueeze(1)
        once = cross(half, own)
        parts += [rows[6 * k : 6 * k + 3], own + 0.5 * once + (1.0 / 6.0) * cross(half, once)]
    return cat(parts).transpose(0, 1)


def _on_bodies(e: Elements, ends: tuple[Any, Any]) -> Any:
    """Wrenches [6, k, n, ...] in the axes of both frames as forces in ground axes and torques in body axes [12, k, n, ...]."""
    parts = []
    for k, w in enumerate(ends):
        own = matmul(e.turn[k], w[:3])
        parts += [matmul(e.A[k], own), matmul(e.turn[k], w[3:]) + matmul(skew(e.arm[k]), own)]
    return cat(parts)


def _turning(e: Elements) -> Any:
    """Forces turn with their bodies [12, 12, n, ...]."""
    rows = []
    for k, w in enumerate(wrenches(e.screw, e.force)):
        by_turn = -matmul(e.A[k], skew(matvec(e.turn[k], w[:3])))
        o = by_turn * 0.0
        wide = cat([o, o], 1)
        rows += [cat([o, by_turn, wide] if k == 0 else [wide, o, by_turn], 1), cat([wide, wide], 1)]
    return cat(rows)


def matrix_entries(T: Any, block: np.ndarray) -> np.ndarray:
    """Row, column and place of the entries of the block [12, 12, n] in the matrix of all rates [3, entries]."""
    n, count = T.bodies, block.shape[-1]
    body = np.array(T.beams.bodies).reshape(2, count)
    rate = np.concatenate([np.arange(6)[:, None] * n + own for own in body])  # [12, n]
    moving = np.repeat(body < n, 6, 0)
    both = moving[:, None] & moving[None]
    row, column = np.broadcast_arrays(rate[:, None], rate[None])
    return np.stack([row[both], column[both], block[both]])


def stored_energy(T: Any, data: Any, at: Any) -> Any:
    """Of all elements [1, ...]."""
    e = elements(T, data, at)
    return 0.5 * dot(e.screw - data["beam_rest"], e.force).sum(0)


def dissipation(T: Any, data: Any, at: Any, rates: tuple[Any, Any]) -> Any:
    """Power that their dampers take [1, ...]."""
    rate = elements(T, data, at, rates).rate
    return (data["beam_damping"] * dot(rate, matvec(data["beam_stiffness"], rate))).sum(0)
