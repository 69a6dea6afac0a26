"""Functions of a program as one C++ text: functions of values, and functions of inputs that change while the values stay.

Functions of changing inputs (tangents of one variable, cotangents of one response) are called many times for the same values.
The numbers that they need of these values are computed once, by `boundary`, and stored.
Checked in tests/extensions/native/codegen/.
"""

from __future__ import annotations

from collections.abc import Iterable

from torchmbd.extensions.native.codegen.emit import Emitter
from torchmbd.extensions.native.codegen.program import Dependence, Program, Write, product, row_major
from torchmbd.extensions.native.codegen.schedule import Schedule
from torchmbd.extensions.native.codegen.size import Variable

CHEAP = 2  # numbers of at most so many operations are computed again instead of being stored


class Module:
    """Functions by name; `moving`: inputs that change while values stay."""

    def __init__(self, program: Program, moving: Iterable[str]):
        self.program, self._moves = program, Dependence(program, moving)
        self.values: dict[str, list[Write]] = {}
        self.moving: dict[str, list[Write]] = {}
        self._cost: dict[int, int] = {}

    def text(self) -> str:
        """C++ of all functions, of `layout` and, if there are functions of changing inputs, of `boundary`."""
        emitter, required, kept = Emitter(self.program), set(), {}
        for writes in self.moving.values():
            self._needs(writes, required, kept)
        aliases, stored = self._kept(kept)
        roots = [w for name in sorted(required) for w in self.program.buffers[name].writes] + stored
        texts = [emitter.function(name, Schedule(self.program, writes, set())) for name, writes in self.values.items()]
        complete = required | {w.buffer for w in stored}
        if self.moving:
            texts.append(emitter.function("boundary", Schedule(self.program, roots, set()), complete))
        for name, writes in self.moving.items():
            texts.append(emitter.function(name, Schedule(self.program, writes, complete, aliases)))
        return "\n".join([emitter.layout(), *texts])

    def _needs(self, writes: list[Write], required: set[str], kept: dict[int, None]) -> None:
        """Collect the buffers and numbers of fixed values that some writes need."""
        buffers, seen = self.program.buffers, set()
        stack, done = [w.number for w in writes], set()
        while stack:
            node = stack.pop()
            if node in seen:
                continue
            seen.add(node)
            if not self._moves(node):
                self._fixed(node, required, kept)
            elif self.program.op[node] == "load":
                name = self.program.args[node][0]
                if buffers[name].kind == "scratch" and name not in done:
                    done.add(name)
                    stack += [w.number for w in buffers[name].writes]
            else:
                stack += self.program.operands(node)

    def _fixed(self, node: int, required: set[str], kept: dict[int, None]) -> None:
        """Collect a number of fixed values, or the buffers that it is computed from if that is cheap."""
        if self._cost_of(node) > CHEAP:
            kept[node] = None
            return
        for x in self.program.reachable([node]):
            if self.program.op[x] == "load" and self.program.buffers[self.program.args[x][0]].kind == "scratch":
                required.add(self.program.args[x][0])

    def _cost_of(self, node: int) -> int:
        """Number of operations that compute a number from the contents of buffers."""
        if node not in self._cost:
            reach = self.program.reachable([node])
            self._cost[node] = sum(self.program.op[x] not in ("load", "constant") for x in reach)
        return self._cost[node]

    def _kept(self, kept: dict[int, None]) -> tuple[dict[int, int], list[Write]]:
        """Loads in place of stored numbers, and the writes that store them."""
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in kept:
            over = tuple(sorted(self.program.variables(x), key=self.program.rank))
            groups.setdefault(over, []).append(x)
        aliases, writes = {}, []
        for over, numbers in groups.items():
            buffer = self.program.scratch(len(numbers) * product(v.size for v in over))
            for k, x in enumerate(numbers):
                index = row_major(over).times(len(numbers)).plus(k)
                self.program.write(buffer, over, index, x)
                aliases[x] = self.program._node("load", buffer.name, index)
        for name in dict.fromkeys(self.program.args[x][0] for x in aliases.values()):
            writes += self.program.buffers[name].writes
        return aliases, writes
