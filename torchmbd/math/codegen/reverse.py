"""Reverse mode on a program: derivatives of weighted sums of what it writes, by what stands in its buffers.

    s = sum of weights * what a buffer holds      ->      ds/dx, added to a buffer like that of x

Each operation hands on what it is worth to its arguments, last operation first. What holds for all values of a loop
variable is worth the sum over them; what is loaded at an index gets what it is worth added there: a sum becomes a
repetition, a gather becomes a sum of segments, and the other way round.
A branch that is not taken (`where`) is worth zero, and so is what it is made of, though that may be nan.
Checked in tests/math/codegen/test_reverse.py.
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, section 3.2.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping

from torchmbd.math.codegen.program import Program, Write
from torchmbd.math.codegen.rules import PLAIN, RULES, Conditions, chosen_under, shared
from torchmbd.math.codegen.size import Index, Untraceable, Variable

Places = frozenset[Variable]


class Pullback:
    """Derivatives by the buffers `by`: name -> name of an output to which they are added.

    weights   load(index) of what each number of the outputs is worth
    """

    def __init__(self, program: Program, by: Mapping[str, str]):
        self.program, self.by = program, dict(by)
        self.worth: dict[int, dict[Places, int]] = {}  # of a number, for all values of some variables
        self.under: dict[int, Conditions] = {}
        self.bars: dict[str, str] = {}  # of scratch buffers
        self.writes: list[Write] = []
        self._heap: list[tuple[int, int, str]] = []
        self._moving: dict[str, bool] = {}

    def __call__(self, outputs: list[Write], weight: Callable[[Index], int]) -> list[Write]:
        """The writes to the outputs of derivatives."""
        for write in outputs:
            self._give(write.number, weight(write.index), frozenset(write.variables), ())
        while self._heap:
            _, node, buffer = heapq.heappop(self._heap)
            if buffer:
                self._buffer(buffer)
            elif self.program.op[node] == "load":
                self._load(node)
            else:
                self._operation(node)
        return self.writes

    def moving(self, number: int) -> bool:
        """Whether a number depends on the buffers by which derivatives are taken."""
        return any(self._is_moving(self.program.args[x][0]) for x in self._loads(number))

    def _loads(self, number: int) -> list[int]:
        return [x for x in self.program.reachable([number]) if self.program.op[x] == "load"]

    def _is_moving(self, name: str) -> bool:
        if name not in self._moving:
            buffer = self.program.buffers[name]
            scratch = buffer.kind == "scratch"
            self._moving[name] = name in self.by or (scratch and any(self.moving(w.number) for w in buffer.writes))
        return self._moving[name]

    def _give(self, node: int, bar: int, places: Places, conditions: Conditions) -> None:
        """What a number is worth for all values of the variables `places`."""
        if bar == self.program.zero or not self._moves(node):
            return
        worth = self.worth.get(node)
        if worth is None:
            worth = self.worth[node] = {}
            heapq.heappush(self._heap, (-node, node, ""))
        self.under[node] = shared(self.under.get(node, conditions), conditions)
        worth[places] = self.program.call("add", worth[places], bar) if places in worth else bar

    def _moves(self, node: int) -> bool:
        known = self._memo.get(node) if hasattr(self, "_memo") else None
        if known is None:
            if not hasattr(self, "_memo"):
                self._memo: dict[int, bool] = {}
            for x in self.program.reachable([node], self._memo):
                if self.program.op[x] == "load":
                    self._memo[x] = self._is_moving(self.program.args[x][0])
                else:
                    self._memo[x] = any(self._memo[a] for a in self.program.operands(x))
            known = self._memo[node]
        return known

    def _total(self, node: int) -> int:
        """What a number is worth: summed over the variables on which it does not depend."""
        own, total = self.program.variables(node), self.program.zero
        for places, bar in self.worth.pop(node).items():
            assert own <= places
            over = sorted(places - own, key=self.program.rank)
            found = self.program.sums_over(bar, own, over) if over else bar
            total = self.program.call("add", total, found)
        return total

    def _operation(self, node: int) -> None:
        program = self.program
        bar, op, args = self._total(node), program.op[node], program.args[node]
        if op not in RULES:
            raise Untraceable(f"the operation {op!r} has no derivative in reverse mode")
        under = self.under.pop(node)
        own = [under] * len(args)
        if op == "where":
            own = [under, (*under, (args[0], True)), (*under, (args[0], False))]
        places = program.variables(node)
        for a, share, conditions in zip(args, RULES[op](program, bar, node, args), own, strict=True):
            if self._moves(a):
                share = share if op in PLAIN else chosen_under(program, under, share)
                self._give(a, share, places, conditions)

    def _load(self, node: int) -> None:
        program = self.program
        name, index = program.args[node]
        bar, places = self._total(node), program.variables(node)
        self.under.pop(node)
        if name in self.by:
            to = program.buffers[self.by[name]]
            self.writes.append(Write(to.name, program.loops(places, index), index, bar, True))
            return
        if name not in self.bars:
            self.bars[name] = program.scratch(program.buffers[name].size).name
            heapq.heappush(self._heap, (-program.buffers[name].order + 1, -1, name))
        program.write(program.buffers[self.bars[name]], sorted(places, key=program.rank), index, bar, adds=True)

    def _buffer(self, name: str) -> None:
        """What the writes to a buffer are worth."""
        program, bars = self.program, self.bars[name]
        if not program.buffers[bars].writes:
            return
        for write in program.buffers[name].writes:
            bar = program._node("load", bars, write.index)
            self._give(write.number, bar, frozenset(write.variables), ())
