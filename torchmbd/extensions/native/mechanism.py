"""Counts and tables of one mechanism, by which the code of its kind runs (symbolic.py, factors.cpp).

Checked in tests/extensions/native/test_steps.py.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import torch

from torchmbd.extensions.native.elimination import elimination
from torchmbd.extensions.native.feedback import CalledLaws
from torchmbd.extensions.native.symbolic import groups
from torchmbd.multibody.equations import beams
from torchmbd.multibody.equations.index_maps import SparseMap
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equations.unit_forces import UnitForces
from torchmbd.multibody.saddle.blocks import SaddleBlocks
from torchmbd.multibody.saddle.matrix import entry_count, entry_numbers, saddle_entries


class _Struct(ctypes.Structure):
    """The struct of this name in factors.cpp: fields, order and types are the same."""

    _fields_ = [
        ("sizes", ctypes.c_void_p),
        ("tables", ctypes.c_void_p),
        ("constants", ctypes.c_void_p),
        ("size", ctypes.c_long),
        *(
            (name, ctypes.c_void_p)
            for name in ("order", "start", "later", "later_pivots", "base", "target", "scattered")
        ),
        ("fills", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in ("to", "from", "factor")),
        ("products", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in ("product_to", "weight", "first", "second", "product_factor")),
        *((name, ctypes.c_void_p) for name in ("row", "column")),
        *((name, ctypes.c_long) for name in ("called", "pairs")),
        *((name, ctypes.c_void_p) for name in ("pair_to", "pair_from")),
    ]


class Mechanism:
    """Of one topology; `actions`: whether the matrix has the slopes of actions."""

    def __init__(self, T: Topology, rows: UnitForces, slopes: bool):
        self.T = T
        self.groups = groups(T)
        actions = UnitForces(T, [(m, c[None]) for m, c in self._members()])
        self.blocks = SaddleBlocks(T, rows, actions)
        self.called = CalledLaws([law for some in self.groups.values() for _, _, law in some])
        self.sizes, self.tables, self.constants = self._sizes(), self._tables(), self._constants()
        self._matrix(slopes)
        del self.T, self.groups, self.blocks  # a topology is kept by its bodies, not by its mechanism (library.py)

    def _members(self) -> list[tuple[list[torch.Tensor], np.ndarray]]:
        """Of each form of action: vectors of its arguments, and numbers of its actions."""
        result, start = [], 0
        for some in self.groups.values():
            kind = self.T.actions[some[0][0]]
            index = torch.tensor([i for _, i, _ in some])
            result.append(([m[index] for m in kind.members], np.arange(start, start + len(some))))
            start += len(some)
        return result

    def _sizes(self) -> dict[str, int]:
        T, rows, actions = self.T, self.blocks.rows, self.blocks.actions
        sizes = {
            "B": T.bodies,
            "F": T.flexible,
            "M": T.modes,
            "V": T.vectors,
            "W": T.attached_flexible,
            "C": T.known_bodies,
        }
        sizes |= {"U": T.n_v, "E": _entries(T.spread), "G": _entries(T.gather)}
        sizes |= {"K": T.turn_count}
        sizes |= {f"P{i}": len(p.members[0]) for i, p in enumerate(T.primitives)}
        sizes |= {f"A{i}": len(some) for i, some in enumerate(self.groups.values())}
        sizes |= {"J": 0 if T.beams is None else len(T.beams.ends) // 2}
        for letter, units in (("R", rows), ("D", actions)):
            counts = (len(units.flexible_arguments), len(units.pairs), len(units.flexible_pairs))
            sizes |= {f"{letter}{x}": n for x, n in zip("TPF", counts, strict=True)}
        return sizes

    def _tables(self) -> dict[str, np.ndarray]:
        T, n = self.T, self.T.bodies
        body = T.vector_body.tolist()
        forces = [b if x.is_point and b < n else 2 * n for x, b in zip(T.attached, body, strict=True)]
        torques = [n + b if b < n else 2 * n for b in body]
        acting = [i for members, _ in self._members() for m in members for i in m.tolist()]
        tables: dict[str, Any] = {
            "vector_body": body,
            "vector_origin": T.vector_origin,
            "vector_flexible": T.vector_flexible,
            "vector_body_only": [min(b, n) for b in body],
            "argument_vectors": T.argument_vectors,
            "action_vectors": acting,
            "body_groups": forces + torques,
        }
        for name, units in (("row", self.blocks.rows), ("action", self.blocks.actions)):
            left_out = len(units.pairs)
            tables |= {
                f"{name}_pair_body": units.pair_body,
                f"{name}_argument_vector": units.argument_vector,
                f"{name}_argument_pair": [left_out if p < 0 else p for p in units.argument_pair],
                f"{name}_point_pair": [left_out if p < 0 else p for p in units.point_pair],
                f"{name}_bent_argument": units.flexible_arguments,
                f"{name}_bent_vector": units.flexible_vector,
                f"{name}_bent_pair": units.flexible_pair,
            }
        if T.beams is not None:
            on = T.beams.bodies
            tables["beam_ends"] = T.beams.ends
            tables["beam_groups"] = [b if b < n else 2 * n for b in on] + [min(n + b, 2 * n) for b in on]
        if T.turns is not None:
            tables |= {"turns_first": T.turns.first, "turns_second": T.turns.second}
            tables["turns"] = [i for p in T.primitives for index in p.turns for i in index.tolist()]
        for name, sparse in (("spread", T.spread), ("gather", T.gather)):
            if sparse is not None:
                row, column = torch.nonzero(sparse.matrix, as_tuple=True)
                tables |= {f"{name}_row": row, f"{name}_column": column}
        return {name: np.ascontiguousarray(x, dtype=np.intc) for name, x in tables.items()}

    def _constants(self) -> dict[str, np.ndarray]:
        T = self.T
        constants = {"unit": np.eye(T.modes), "ground_A": np.eye(3), "ground_r": np.zeros(3)}
        if T.turns is not None:
            constants["turns_axes"] = T.turns.axes.numpy()
        for name, sparse in (("spread", T.spread), ("gather", T.gather)):
            if sparse is not None:
                constants[f"{name}_factor"] = sparse.matrix[sparse.matrix != 0.0].numpy()
        return {name: np.ascontiguousarray(x, dtype=np.float64) for name, x in constants.items()}

    def _matrix(self, slopes: bool) -> None:
        """Where the entries of the matrix come from and go to."""
        T = self.T
        row, column, place = saddle_entries(T, self.blocks)
        if T.beams is not None and slopes:
            beam_entries = beams.matrix_entries(T, entry_numbers(self.blocks.shapes())["beam"])
            row, column, place = (np.concatenate(x) for x in zip((row, column, place), beam_entries, strict=True))
        row, column, place, factor = self._projected(row, column, place)
        total = entry_count(self.blocks.shapes())
        products = self._products(total) if slopes and T.actions else [np.empty(0, dtype=np.int64)] * 6
        n = T.n_v + T.rows
        all_rows, all_columns = (
            np.concatenate(x).astype(np.int64) for x in ((row, products[0]), (column, products[1]))
        )
        self.elimination = e = elimination(n, T.n_v, all_rows, all_columns)
        integers = {
            "to": e.addresses(row, column),
            "from": place,
            "product_to": e.addresses(products[0].astype(np.int64), products[1].astype(np.int64)),
            "weight": products[2],
            "first": products[3],
            "second": products[4],
        }
        self.matrix: dict[str, np.ndarray] = {k: np.ascontiguousarray(x, dtype=np.intc) for k, x in integers.items()}
        self.matrix |= {"factor": factor, "product_factor": products[5].astype(np.float64)}

    def _expanded(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each row of all rates (or constraint): which it is, its independent rates and their factors."""
        T = self.T
        if T.rates is None:
            return np.arange(len(row)), row, np.ones(len(row))
        N = T.rates.numpy()
        i, a = np.nonzero(N)
        i = np.concatenate([i, np.arange(T.n_rates, T.n_rates + T.rows)])
        f = np.concatenate([N[N != 0.0], np.ones(T.rows)])
        a = np.concatenate([a, np.arange(T.n_v, T.n_v + T.rows)])
        first = np.searchsorted(i, row)
        count = np.searchsorted(i, row, "right") - first
        which = np.repeat(np.arange(len(row)), count)
        at = np.repeat(first, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return which, a[at], f[at]

    def _projected(self, row: np.ndarray, column: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, ...]:
        """Entries of P' K P (saddle.Projection) of the entries of K."""
        which, row, row_factor = self._expanded(row)
        again, column, column_factor = self._expanded(column[which])
        return row[again], column, place[which][again], row_factor[again] * column_factor

    def _products(self, total: int) -> list[np.ndarray]:
        """Rows, columns, weights, first and second entries and factors of the slopes of actions."""
        shapes = self.blocks.action_shapes()
        rate, action, place = self.blocks.actions.matrix_entries(self.T, entry_numbers(shapes), "action")
        which, rate, factor = self._expanded(rate)
        action, place = action[which], total + place[which]
        weights, count = total + entry_count(shapes), sum(len(some) for some in self.groups.values())
        products = []
        for i in range(len(self.blocks.actions.pairs) and int(action.max()) + 1):
            members = np.nonzero(action == i)[0]
            first, second = (x.ravel() for x in np.meshgrid(members, members, indexing="ij"))
            weight = np.full(len(first), weights + i)
            products.append(
                [rate[first], rate[second], weight, place[first], place[second], factor[first] * factor[second]]
            )
        for pair, (i, j) in enumerate(self.called.pairs):
            both = (np.nonzero(action == self.called.actions[k])[0] for k in (i, j))
            first, second = (x.ravel() for x in np.meshgrid(*both, indexing="ij"))
            weight = np.full(len(first), weights + count + pair)
            products.append(
                [rate[first], rate[second], weight, place[first], place[second], factor[first] * factor[second]]
            )
        return (
            [np.concatenate(x) for x in zip(*products, strict=True)] if products else [np.empty(0, dtype=np.int64)] * 6
        )

    def struct(self, code: ctypes.CDLL) -> Any:
        """The mechanism as a library takes it; what it points to lives as long as it."""
        sizes, tables, constants = (part.split() for part in code.needed().decode().split("|"))
        counts = np.array([self.sizes[name] for name in sizes], dtype=np.int64)
        pointers = np.array([self.tables[name].ctypes.data for name in tables] or [0], dtype=np.uint64)
        numbers = np.array([self.constants[name].ctypes.data for name in constants] or [0], dtype=np.uint64)
        e = self.elimination
        s = _Struct(counts.ctypes.data, pointers.ctypes.data, numbers.ctypes.data, e.size)
        for name in ("order", "start", "later", "later_pivots", "base", "target", "scattered", "row", "column"):
            setattr(s, name, getattr(e, name).ctypes.data)
        s.fills, s.products = len(self.matrix["to"]), len(self.matrix["product_to"])
        for name, x in self.matrix.items():
            setattr(s, name, x.ctypes.data)
        s.called, s.pairs = len(self.called.actions), len(self.called.pairs)
        pairs = np.array(self.called.pairs, dtype=np.intc).reshape(-1, 2).T.copy()
        s.pair_to, s.pair_from = (x.ctypes.data for x in pairs)
        s.kept = (self, counts, pointers, numbers, pairs)
        return s


def _entries(sparse: SparseMap | None) -> int:
    return 0 if sparse is None else int((sparse.matrix != 0.0).sum())
