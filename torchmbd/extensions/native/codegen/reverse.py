"""Reverse mode on a program: derivatives of weighted sums of its outputs by the contents of its buffers.

    s = sum of weights * contents of an output      ->      ds/dx, added to a buffer of the shape of x

The cotangent of a number x is ds/dx. Operations pass cotangents to their arguments, last operation first. A number that does
not depend on a loop variable has the sum of the cotangents over this variable; a load adds its cotangent to a buffer at its
index, so the derivative of a sum is a repetition, that of a gather a sum of segments, and the other way round.
The cotangents of the unused branch of `where` are zero, also where its numbers are nan.
Checked in tests/extensions/native/codegen/test_reverse.py.
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, section 3.2.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping

from torchmbd.extensions.native.codegen.program import Dependence, Program, Write
from torchmbd.extensions.native.codegen.rules import PLAIN, RULES, Conditions, common_conditions, zero_unless
from torchmbd.extensions.native.codegen.size import Index, Untraceable, Variable

Loops = frozenset[Variable]


class Pullback:
    """Derivatives with respect to the buffers `by`: name -> name of an output to which they are added."""

    def __init__(self, program: Program, by: Mapping[str, str]):
        self.program, self.by = program, dict(by)
        self.cotangents: dict[
            int, dict[Loops, int]
        ] = {}  # number -> loop variables -> cotangent for each of their values
        self.conditions: dict[int, Conditions] = {}  # of the branches that use a number
        self.buffer_cotangents: dict[str, str] = {}  # scratch buffer -> buffer of its cotangents
        self.writes: list[Write] = []
        self._heap: list[tuple[int, int, str]] = []
        self._depends = Dependence(program, self.by)

    def __call__(self, outputs: list[Write], weight: Callable[[Index], int]) -> list[Write]:
        """The writes of the derivatives; weight(index) is the number that weights an output at an index."""
        for write in outputs:
            self._add_cotangent(write.number, weight(write.index), frozenset(write.variables), ())
        while self._heap:
            _, node, buffer = heapq.heappop(self._heap)
            if buffer:
                self._buffer(buffer)
            elif self.program.op[node] == "load":
                self._load(node)
            else:
                self._operation(node)
        return self.writes

    def _add_cotangent(self, node: int, cotangent: int, loops: Loops, conditions: Conditions) -> None:
        """Add a cotangent for each value of some loop variables to a number."""
        if cotangent == self.program.zero or not self._depends(node):
            return
        cotangents = self.cotangents.get(node)
        if cotangents is None:
            cotangents = self.cotangents[node] = {}
            heapq.heappush(self._heap, (-node, node, ""))
        self.conditions[node] = common_conditions(self.conditions.get(node, conditions), conditions)
        cotangents[loops] = self.program.call("add", cotangents[loops], cotangent) if loops in cotangents else cotangent

    def _summed_cotangent(self, node: int) -> int:
        """The cotangent of a number, summed over the variables on which the number does not depend."""
        variables, total = self.program.variables(node), self.program.zero
        for loops, cotangent in self.cotangents.pop(node).items():
            assert variables <= loops
            over = sorted(loops - variables, key=self.program.rank)
            cotangent = self.program.sums_over(cotangent, variables, over) if over else cotangent
            total = self.program.call("add", total, cotangent)
        return total

    def _operation(self, node: int) -> None:
        program = self.program
        cotangent, op, args = self._summed_cotangent(node), program.op[node], program.args[node]
        if op not in RULES:
            raise Untraceable(f"the operation {op!r} has no derivative in reverse mode")
        conditions = self.conditions.pop(node)
        of_arguments = [conditions] * len(args)
        if op == "where":
            of_arguments = [conditions, (*conditions, (args[0], True)), (*conditions, (args[0], False))]
        loops = program.variables(node)
        for a, share, conditions_of_a in zip(
            args, RULES[op](program, cotangent, node, args), of_arguments, strict=True
        ):
            if self._depends(a):
                share = share if op in PLAIN else zero_unless(program, conditions, share)
                self._add_cotangent(a, share, loops, conditions_of_a)

    def _load(self, node: int) -> None:
        program = self.program
        name, index = program.args[node]
        cotangent, loops = self._summed_cotangent(node), program.variables(node)
        self.conditions.pop(node)
        if name in self.by:
            to = program.buffers[self.by[name]]
            self.writes.append(Write(to.name, program.loops(loops, index), index, cotangent, True))
            return
        if name not in self.buffer_cotangents:
            self.buffer_cotangents[name] = program.scratch(program.buffers[name].size).name
            heapq.heappush(self._heap, (-program.buffers[name].order + 1, -1, name))
        program.write(
            program.buffers[self.buffer_cotangents[name]], sorted(loops, key=program.rank), index, cotangent, adds=True
        )

    def _buffer(self, name: str) -> None:
        """Pass the cotangents of a buffer to the numbers that are written to it."""
        program, cotangents = self.program, self.buffer_cotangents[name]
        if not program.buffers[cotangents].writes:
            return
        for write in program.buffers[name].writes:
            cotangent = program._node("load", cotangents, write.index)
            self._add_cotangent(write.number, cotangent, frozenset(write.variables), ())
