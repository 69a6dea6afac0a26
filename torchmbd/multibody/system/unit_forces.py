"""What unit multipliers, or unit strengths of applied forces, do to the bodies: columns of Phi_q' and of force directions.

A column acts on the vectors of its arguments; per argument it is a slot. Slots of one column on one body are added up: a
pair (column, body).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchmbd.math.pair import cross, matvec_t
from torchmbd.multibody.system.topology import SegmentSum, Topology

Block = tuple[str, tuple[int, ...]]  # name and shape


class UnitForces:
    """Index tensors of the columns of one topology.

    slot_pair, point_pair, flexible_pair   pair of each slot, or -1: of all, of those on points, of those on flexible bodies
    members   of each kind: the vectors of each argument [n], and the columns of each component [components, n]
    """

    def __init__(self, T: Topology, members: Sequence[tuple[Sequence[torch.Tensor], np.ndarray]]):
        slot_vector, slot_column = [], []
        for vectors, columns in members:
            for member in vectors:
                for component in columns:
                    slot_vector += member.tolist()
                    slot_column += component.tolist()
        body = T.vector_body.tolist()
        slots = list(zip(slot_column, slot_vector, strict=True))
        self.pairs = sorted({(c, body[v]) for c, v in slots if body[v] < T.bodies})
        place = {key: i for i, key in enumerate(self.pairs)}
        pair_of = [place.get((c, body[v]), -1) for c, v in slots]
        points = [pair if T.attached[v].is_point else -1 for pair, v in zip(pair_of, slot_vector, strict=True)]
        self.pair_body = torch.tensor([b for _, b in self.pairs], dtype=torch.long)
        self.slot_vector = torch.tensor(slot_vector, dtype=torch.long)
        self.slot_pair, self.point_pair = pair_of, points
        self.turn_fold, self.force_fold = SegmentSum(pair_of, len(self.pairs)), SegmentSum(points, len(self.pairs))
        flexible = [i for i, v in enumerate(slot_vector) if v < T.attached_flexible]
        self.flexible_slots = torch.tensor(flexible, dtype=torch.long)
        self.flexible_vector = self.slot_vector[self.flexible_slots]
        self.flexible_pairs = [key for key in self.pairs if key[1] < T.flexible]
        bent = {key: i for i, key in enumerate(self.flexible_pairs)}
        self.flexible_pair = [bent[self.pairs[pair_of[i]]] for i in flexible]
        self.modal_fold = SegmentSum(self.flexible_pair, len(bent))

    def blocks(self, data: Any, at: Any, force: Any, name: str) -> dict[str, Any]:
        """Forces and torques [3, pairs], modal forces [modes, flexible pairs] of the forces of slots [3, slots, ...]."""
        local = matvec_t(at.A_of.index_select(2, self.slot_vector), force)
        blocks = {
            f"{name}_force": self.force_fold(force),
            f"{name}_torque": self.turn_fold(cross(at.rho.index_select(1, self.slot_vector), local)),
        }
        if self.flexible_pairs:
            Y = data["Y"].index_select(2, self.flexible_vector)
            blocks[f"{name}_modal"] = self.modal_fold(matvec_t(Y, local.index_select(1, self.flexible_slots)))
        return blocks

    def shapes(self, modes: int, name: str) -> list[Block]:
        """Names and shapes of `blocks`."""
        pairs = 3, len(self.pairs)
        return [
            (f"{name}_force", pairs),
            (f"{name}_torque", pairs),
            (f"{name}_modal", (modes, len(self.flexible_pairs))),
        ]

    def places(self, T: Topology, blocks: dict[str, np.ndarray], name: str) -> np.ndarray:
        """Rate, column and place [3, n] of each entry, out of the places of blocks."""
        n, found = T.bodies, []
        column, body = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        for i in range(3):
            found.append((i * n + body, column, blocks[f"{name}_force"][i]))
            found.append(((3 + i) * n + body, column, blocks[f"{name}_torque"][i]))
        column, body = np.array(self.flexible_pairs, dtype=int).reshape(-1, 2).T
        for a in range(T.modes if self.flexible_pairs else 0):
            found.append((6 * n + a * T.flexible + body, column, blocks[f"{name}_modal"][a]))
        return np.concatenate([np.array(x, dtype=int).reshape(3, -1) for x in found], 1)


def of_rows(T: Topology) -> UnitForces:
    """Of unit multipliers."""
    return UnitForces(
        T, [(p.members, np.arange(rows.start, rows.stop).reshape(p.rows, -1)) for p, rows in T.row_slices()]
    )


def of_actions(T: Topology) -> UnitForces:
    """Of unit strengths of the actions, counted kind by kind."""
    members, start = [], 0
    for action in T.actions:
        n = len(action.members[0])
        members.append((action.members, np.arange(start, start + n)[None]))
        start += n
    return UnitForces(T, members)
