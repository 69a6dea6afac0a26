"""Generalized forces of unit multipliers (columns of Phi_q') and of unit strengths of actions (their directions).

A column has a force on each vector of its arguments. The forces of one column on one body are added up: a pair (column, body).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchmbd.math.pair import cross, matvec_t
from torchmbd.multibody.equations.index_maps import SegmentSum
from torchmbd.multibody.equations.topology import Topology

Block = tuple[str, tuple[int, ...]]  # name and shape


class UnitForces:
    """Index tensors of the columns of one topology.

    members          for each kind the vectors of each argument [n], and the columns of each component [components, n]
    argument_pair    pair of each argument, -1 on known bodies
    point_pair       the same for arguments that are points, else -1
    flexible_pair    pair of each argument on a flexible body, counted among the pairs of flexible bodies
    """

    def __init__(self, T: Topology, members: Sequence[tuple[Sequence[torch.Tensor], np.ndarray]]):
        argument_vector, argument_column = [], []
        for vectors, columns in members:
            for member in vectors:
                for component in columns:
                    argument_vector += member.tolist()
                    argument_column += component.tolist()
        body = T.vector_body.tolist()
        arguments = list(zip(argument_column, argument_vector, strict=True))
        self.pairs = sorted({(c, body[v]) for c, v in arguments if body[v] < T.bodies})
        position = {key: i for i, key in enumerate(self.pairs)}
        pair_of = [position.get((c, body[v]), -1) for c, v in arguments]
        points = [pair if T.attached[v].is_point else -1 for pair, v in zip(pair_of, argument_vector, strict=True)]
        self.pair_body = torch.tensor([b for _, b in self.pairs], dtype=torch.long)
        self.argument_vector = torch.tensor(argument_vector, dtype=torch.long)
        self.argument_pair, self.point_pair = pair_of, points
        self.turn_sum, self.force_sum = SegmentSum(pair_of, len(self.pairs)), SegmentSum(points, len(self.pairs))
        flexible = [i for i, v in enumerate(argument_vector) if v < T.attached_flexible]
        self.flexible_arguments = torch.tensor(flexible, dtype=torch.long)
        self.flexible_vector = self.argument_vector[self.flexible_arguments]
        self.flexible_pairs = [key for key in self.pairs if key[1] < T.flexible]
        bent = {key: i for i, key in enumerate(self.flexible_pairs)}
        self.flexible_pair = [bent[self.pairs[pair_of[i]]] for i in flexible]
        self.modal_sum = SegmentSum(self.flexible_pair, len(bent))

    def blocks(self, data: Any, at: Any, force: Any, name: str) -> dict[str, Any]:
        """Forces, torques [3, pairs] and modal forces [modes, flexible pairs], out of forces on the arguments
        [3, arguments, ...]."""
        local = matvec_t(at.A_of.index_select(2, self.argument_vector), force)
        blocks = {
            f"{name}_force": self.force_sum(force),
            f"{name}_torque": self.turn_sum(cross(at.rho.index_select(1, self.argument_vector), local)),
        }
        if self.flexible_pairs:
            Y = at.Y.index_select(2, self.flexible_vector)
            blocks[f"{name}_modal"] = self.modal_sum(matvec_t(Y, local.index_select(1, self.flexible_arguments)))
        return blocks

    def shapes(self, modes: int, name: str) -> list[Block]:
        """Names and shapes of `blocks`."""
        pairs = 3, len(self.pairs)
        return [
            (f"{name}_force", pairs),
            (f"{name}_torque", pairs),
            (f"{name}_modal", (modes, len(self.flexible_pairs))),
        ]

    def matrix_entries(self, T: Topology, blocks: dict[str, np.ndarray], name: str) -> np.ndarray:
        """Rate, column and entry number of each entry of the blocks [3, n]; blocks: entry numbers by saddle.entry_numbers."""
        n, entries = T.bodies, []
        column, body = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        for i in range(3):
            entries.append((i * n + body, column, blocks[f"{name}_force"][i]))
            entries.append(((3 + i) * n + body, column, blocks[f"{name}_torque"][i]))
        column, body = np.array(self.flexible_pairs, dtype=int).reshape(-1, 2).T
        for a in range(T.modes if self.flexible_pairs else 0):
            entries.append((6 * n + a * T.flexible + body, column, blocks[f"{name}_modal"][a]))
        return np.concatenate([np.array(x, dtype=int).reshape(3, -1) for x in entries], 1)


def unit_multipliers(T: Topology) -> UnitForces:
    """Forces of unit multipliers of all constraint rows."""
    return UnitForces(
        T, [(p.members, np.arange(rows.start, rows.stop).reshape(p.rows, -1)) for p, rows in T.row_slices()]
    )


def unit_strengths(T: Topology) -> UnitForces:
    """Forces of unit strengths of all actions, which are counted kind by kind."""
    members, start = [], 0
    for action in T.actions:
        n = len(action.members[0])
        members.append((action.members, np.arange(start, start + n)[None]))
        start += n
    return UnitForces(T, members)
