"""Which bodies forces and joints couple, and the few directions from which matrices of tangents follow.

    X D  ->  X          D [n_v, k]: sums of unit vectors of degrees of freedom that no row of X has together

A row of the equations of motion belongs to a body; it has entries for that body and for those that share a joint, an action, a
beam element or a controller with it. Bodies get colors so that no two of a set share one; degrees of freedom of one color go
together. A chain of beam elements takes 18 directions, however long it is.
Source: Curtis, Powell and Reid, IMA J. Appl. Math. 13 (1974) 117-119.
Checked in tests/multibody/equations/test_coupling.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Coupling:
    """directions [n_v, k]; column of each row's entry along each direction [n_v + rows, k], n_v where there is none."""

    directions: Tensor
    column: Tensor

    @classmethod
    def of(cls, T: Any) -> Coupling:
        """The directions of a topology; those of all degrees of freedom where its rates are not independent."""
        if T.spread is not None:
            every = torch.arange(T.n_v).expand(T.n_v + T.rows, T.n_v)
            return cls(torch.eye(T.n_v, dtype=torch.float64), every)
        groups, joined = _groups(T), _joined(T)
        near = [{body} for body in range(T.bodies)]
        for group in groups:
            for body in group:
                near[body] |= group
        color = _colors(near)
        freedoms = [_freedoms(T, body) for body in range(T.bodies)]
        first, count = {}, 0
        for c in sorted(set(color)):
            first[c] = count
            count += max(len(freedoms[body]) for body in range(T.bodies) if color[body] == c)
        directions = torch.zeros(T.n_v, count, dtype=torch.float64)
        for body, rows in enumerate(freedoms):
            directions[rows, first[color[body]] + torch.arange(len(rows))] = 1.0
        column = torch.full((T.n_v + T.rows, count), T.n_v)
        coupled = [(rows, near[body]) for body, rows in enumerate(freedoms)]
        coupled += [([T.n_v + row], bodies) for row, bodies in enumerate(joined)]
        for rows, bodies in coupled:
            for body in bodies:
                along = first[color[body]] + torch.arange(len(freedoms[body]))
                column[torch.tensor(rows)[:, None], along] = torch.tensor(freedoms[body])
        return cls(directions, column)

    def matrix(self, X: Tensor, constraints: bool = False) -> Tensor:
        """X [n_v or rows, n_v] by its products with the directions [n_v or rows, k]; constraints: of their rows."""
        n = len(self.directions)
        column = self.column[n:] if constraints else self.column[:n]
        return X.new_zeros(len(X), n + 1).scatter_(1, column, X)[:, :n]


def _freedoms(T: Any, body: int) -> list[int]:
    """Rows of v of a body."""
    rigid = [i * T.bodies + body for i in range(6)]
    return rigid + ([row - T.bodies for row in T.w_slice(body)] if body < T.flexible else [])


def _groups(T: Any) -> list[set[int]]:
    """Bodies that a joint, an action, a beam element or a controller couples."""
    of_actions = [group for action in T.actions for group in _members(T, action.members)]
    groups = [group for primitive in T.primitives for group in _members(T, primitive.members)] + of_actions
    for link in T.links.each:
        touched = (link.coordinates != 0.0).any(0) | (link.writes != 0.0).any(1)
        groups.append(set().union(*(of_actions[i] for i in touched.nonzero()[:, 0].tolist())))
    if T.beams is not None:
        n = len(T.beams.ends) // 2
        pairs = zip(T.beams.bodies[:n], T.beams.bodies[n:], strict=True)
        groups += [{body for body in pair if body < T.bodies} for pair in pairs]
    return groups


def _members(T: Any, members: Any) -> list[set[int]]:
    """Moving bodies of each of several joints or actions of one kind, out of the vectors of their arguments."""
    bodies = [T.vector_body[index].tolist() for index in members]
    return [{body for body in group if body < T.bodies} for group in zip(*bodies, strict=True)]


def _joined(T: Any) -> list[set[int]]:
    """Bodies of each constraint row."""
    return [group for kind in T.primitives for _ in range(kind.rows) for group in _members(T, kind.members)]


def _colors(near: list[set[int]]) -> list[int]:
    """Colors of bodies; those that are near one body differ."""
    color: list[int] = []
    for body, others in enumerate(near):
        of_neighbors = {color[x] for other in others for x in near[other] if x < body}
        color.append(next(c for c in range(len(near) + 1) if c not in of_neighbors))
    return color
