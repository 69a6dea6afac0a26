"""Actions whose laws native code calls back: controllers, and laws of users that cannot be traced.

    values     f = F(s, s', t; weights)          once for every correction of a step, all lanes of a block at a time
    slopes     df/ds, df/ds'                     for the iteration matrix and for tangents, of the pairs of actions that depend
    tangents   dF/dweights dweights              once for a step
    backward   f and slopes at all steps first, then native steps, then dF/dweights at all steps at once

Checked in tests/extensions/native/test_feedback.py: the same numbers as by operators of torch.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchmbd.extensions.native.simd_layout import LANES, addresses
from torchmbd.math.pair import Pair, value
from torchmbd.math.variable import law_key
from torchmbd.multibody.forces.feedback import Links, Port, derivative

R = TypeVar("R")
_CALL = ctypes.CFUNCTYPE(ctypes.c_long, ctypes.c_long, ctypes.c_long, ctypes.c_long)
_STRENGTHS, _SLOPES, _TANGENTS = range(3)  # as in feedback.cpp
_NAMES = ("signals", "strengths", "slopes", "tangents", "strength_tangents")  # of its arrays


class CalledLaws:
    """The called laws of a mechanism.

    actions   numbers of their actions among all actions
    pairs     of actions, counted among these: one whose strength depends on s or s' of the other
    """

    def __init__(self, laws: Sequence[Any]):
        self.actions = [i for i, law in enumerate(laws) if isinstance(law, Port)]
        self.links = Links([laws[i] for i in self.actions]).each
        self.pairs: list[tuple[int, int]] = []
        self._maps = []  # of each link: slopes of its pairs [2, pairs] out of du/dx [outputs inputs]
        for link in self.links:
            rows = link.writes.any(1).nonzero()[:, 0]
            columns = link.coordinates.any(0).nonzero()[:, 0]
            self.pairs += product(rows.tolist(), columns.tolist())
            read = link.coordinates[:, columns]
            by = torch.stack([read * (1.0 - link.rates)[:, None], read * link.rates[:, None]])
            self._maps.append(torch.einsum("ro,dic->drcoi", link.writes[rows], by).flatten(3).flatten(1, 2))

    def parameters(self, data: Mapping[str, Any]) -> list[Tensor]:
        """Weights of each controller [k, lanes or 1]; none of a law."""
        names = [law_key(link.control.name) for link in self.links]
        none = torch.zeros(0, 1, dtype=torch.float64)
        return [
            value(data[name])[:, 0] if link.control.variables else none
            for name, link in zip(names, self.links, strict=True)
        ]

    def inputs(self, signals: Tensor, t: Tensor) -> list[Tensor]:
        """Inputs of each law [inputs, lanes] out of s and s' of all actions [2 n, lanes]."""
        both = torch.cat([signals, t.expand(1, signals.shape[1])])
        return [both[link.read] for link in self.links]

    def strengths(self, u: Sequence[Tensor]) -> Tensor:
        """Strengths of all actions [n, ...] by the outputs of each law [outputs, ...]."""
        parts = [link.writes @ x for link, x in zip(self.links, u, strict=True)]
        return sum(parts[1:], parts[0])

    def slopes(self, jacobians: Sequence[Tensor]) -> Tensor:
        """Slopes of all pairs by s and s' [2, pairs, lanes], out of du/dx [outputs, inputs, lanes] of each law."""
        parts = [by @ J.flatten(0, 1) for by, J in zip(self._maps, jacobians, strict=True)]
        return torch.cat(parts, 1) if len(parts) > 1 else parts[0]

    def with_parameters(self, parameters: Sequence[Tensor], run: Callable[[], R]) -> R:
        """run(), with those parameters set in the modules that are the same for all lanes."""
        for link, p in zip(self.links, parameters, strict=True):
            if p.shape[1] == 1:
                run = partial(link.control.holding, p, run)
        return run()


class _Struct(ctypes.Structure):
    """The struct of this name in feedback.cpp: fields, order and types are the same."""

    _fields_ = [("call", _CALL)] + [(name, ctypes.c_void_p) for name in _NAMES]


class Feedback:
    """Serves the calls while steps are made. times: of the ends of the next steps, to be set before these."""

    def __init__(self, laws: CalledLaws, data: Mapping[str, Any], lanes: int, n_b: int):
        self.laws, self.lanes, self.times = laws, lanes, torch.zeros(1, dtype=torch.float64)
        self.parameters = [p.clone() for p in laws.parameters(data)]
        names = [law_key(link.control.name) for link in laws.links]
        self.weight_tangents = [data[name].tangent if isinstance(data.get(name), Pair) else None for name in names]
        n, pairs = len(laws.actions), len(laws.pairs)
        shapes = [(2 * n,), (n,), (2, pairs), (n_b, n), (n,)]
        self.arrays = [torch.zeros(*shape, LANES, dtype=torch.float64) for shape in shapes]
        self.lane_parameters = [p[:0] if p.shape[1] == 1 else p for p in self.parameters]
        self.error: BaseException | None = None
        self.struct = _Struct(_CALL(self._call), **addresses(dict(zip(_NAMES, self.arrays, strict=True))))

    @property
    def address(self) -> int:
        """Address of the struct for native code."""
        return ctypes.addressof(self.struct)

    def run(self, f: Callable[[], int]) -> int:
        """f() by native code, which calls back; raises what is raised there."""
        status, error = self.laws.with_parameters(self.parameters, f), self.error
        if error is not None:
            self.error = None
            raise error
        return status

    def _call(self, what: int, step: int, block: int) -> int:
        try:
            with torch.inference_mode(False), torch.set_grad_enabled(what == _TANGENTS):
                self._evaluate(what, self.times[step], slice(block * LANES, min((block + 1) * LANES, self.lanes)))
        except BaseException as error:  # native code cannot raise it
            self.error = error
            return 1
        return 0

    def _evaluate(self, what: int, t: Tensor, lanes: slice) -> None:
        signals, strengths, slopes, tangents, _ = self.arrays
        count, links = lanes.stop - lanes.start, self.laws.links
        x = self.laws.inputs(signals[:, :count], t)
        p = [y if y.shape[1] == 1 else y[:, lanes] for y in self.lane_parameters]
        if what == _STRENGTHS:
            _put(strengths, self.laws.strengths([a.control.at(b, c, t) for a, b, c in zip(links, p, x, strict=True)]))
            return
        if what == _TANGENTS:
            p = [
                y if move is None else (all_ if all_.shape[1] == 1 else y).expand(-1, count).clone().requires_grad_()
                for y, all_, move in zip(p, self.parameters, self.weight_tangents, strict=True)
            ]
        pairs = [link.control.with_jacobian(a, b, t) for link, a, b in zip(links, p, x, strict=True)]
        _put(strengths, self.laws.strengths([u.detach() for u, _ in pairs]))
        _put(slopes, self.laws.slopes([J for _, J in pairs]))
        if what == _TANGENTS:
            tangents.zero_()
        for (u, _), link, a, move in zip(pairs, links, p, self.weight_tangents, strict=True):
            if what == _TANGENTS and move is not None:
                by = torch.stack([derivative(y, a) for y in u])
                output_tangents = torch.einsum("okl,ksl->osl", by, move if move.shape[-1] == 1 else move[..., lanes])
                _put(tangents, tangents[..., :count] + torch.einsum("no,osl->snl", link.writes, output_tangents))


class FeedbackAdjoint:
    """Called laws in reverse mode: values at all steps first, cotangents of the weights after the native steps.

    signals    [steps, 2 n, lanes], which give the strengths [steps, n, lanes] and slopes [steps, 2, pairs, lanes]
    variables  names of the weights by which derivatives are wanted
    """

    def __init__(self, laws: CalledLaws, data: Mapping[str, Any], signals: Tensor, times: Tensor, variables: set[str]):
        self.laws, names = laws, [law_key(link.control.name) for link in laws.links]
        self.names = [name if name in variables else None for name in names]
        lanes = signals.shape[-1]
        leaves: dict[int, Tensor] = {}  # one of each module, which holds it for all controllers that share it
        self.parameters = [
            p
            if name is None
            else leaves.setdefault(id(link.control.module), p.expand(-1, lanes).clone().requires_grad_())
            for p, name, link in zip(laws.parameters(data), self.names, laws.links, strict=True)
        ]
        self.outputs: list[list[Tensor]] = []
        with torch.enable_grad():
            pairs = laws.with_parameters(
                self.parameters, lambda: [self._at(x, t) for x, t in zip(signals, times, strict=True)]
            )
        self.strengths, self.slopes = (torch.stack(x) for x in zip(*pairs, strict=True))

    def _at(self, signals: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Strengths and slopes at one time."""
        pairs, laws = [], self.laws
        for link, p, x in zip(laws.links, self.parameters, laws.inputs(signals, t), strict=True):
            u, J = link.control.with_jacobian(p[:0] if p.shape[1] == 1 else p, x, t)
            link.control.check_attached(u, p, t)
            pairs.append((u, J))
        self.outputs.append([u for u, _ in pairs])
        return laws.strengths([u.detach() for u, _ in pairs]), laws.slopes([J for _, J in pairs])

    def cotangents(self, of_strengths: Tensor) -> dict[str, Tensor]:
        """Cotangents of the weights [k, rows, lanes] by those of all strengths [steps, rows, n, lanes]."""
        result = {}
        for k, (name, p, link) in enumerate(zip(self.names, self.parameters, self.laws.links, strict=True)):
            if name is None:
                continue
            of_outputs = torch.einsum("no,trnl->rtol", link.writes, of_strengths)
            outputs = [u[k] for u in self.outputs]
            rows = [torch.autograd.grad(outputs, p, list(row), retain_graph=True)[0] for row in of_outputs]
            result[name] = torch.stack(rows, 1)
        return result


def _put(to: Tensor, x: Tensor) -> None:
    """Copy numbers of the lanes that exist into a block [..., LANES]; the last of them fills it."""
    if x.shape[-1] in (1, LANES):
        to.copy_(x)
        return
    to[..., : x.shape[-1]] = x
    to[..., x.shape[-1] :] = x[..., -1:]
