"""Functions of a program as one C++ text: those of values, and those of what moves while the values stay.

Functions of what moves (tangents of one variable, cotangents of one response) are called many times for the same values.
What they need of these is made once, by `boundary`, and kept.
Checked in tests/math/codegen/.
"""

from __future__ import annotations

from collections.abc import Iterable

from torchmbd.math.codegen.emit import Emitter
from torchmbd.math.codegen.program import Program, Write, product, row_major
from torchmbd.math.codegen.schedule import Schedule
from torchmbd.math.codegen.size import Variable

CHEAP = 2  # operations that are made again rather than kept


class Module:
    """Functions by name; `moving`: inputs that change while values stay."""

    def __init__(self, program: Program, moving: Iterable[str]):
        self.program, self.inputs = program, set(moving)
        self.values: dict[str, list[Write]] = {}
        self.moving: dict[str, list[Write]] = {}
        self._moves: dict[int, bool] = {}
        self._cost: dict[int, int] = {}

    def text(self) -> str:
        """C++ of all functions, of `layout` and, if anything moves, of `boundary`."""
        emitter, required, kept = Emitter(self.program), set(), {}
        for writes in self.moving.values():
            self._needs(writes, required, kept)
        aliases, stored = self._kept(kept)
        roots = [w for name in sorted(required) for w in self.program.buffers[name].writes] + stored
        texts = [emitter.function(name, Schedule(self.program, writes, set())) for name, writes in self.values.items()]
        given = required | {w.buffer for w in stored}
        if self.moving:
            texts.append(emitter.function("boundary", Schedule(self.program, roots, set()), given))
        for name, writes in self.moving.items():
            texts.append(emitter.function(name, Schedule(self.program, writes, given, aliases)))
        return "\n".join([emitter.layout(), *texts])

    def moves(self, node: int) -> bool:
        """Whether a number depends on what moves."""
        for x in self.program.reachable([node], self._moves):
            if self.program.op[x] == "load":
                name = self.program.args[x][0]
                buffer = self.program.buffers[name]
                scratch = buffer.kind == "scratch"
                self._moves[x] = name in self.inputs or (scratch and any(self.moves(w.number) for w in buffer.writes))
            else:
                self._moves[x] = any(self._moves[a] for a in self.program.operands(x))
        return self._moves[node]

    def _needs(self, writes: list[Write], required: set[str], kept: dict[int, None]) -> None:
        """Buffers and numbers of the values that some writes need."""
        buffers, seen = self.program.buffers, set()
        stack, done = [w.number for w in writes], set()
        while stack:
            node = stack.pop()
            if node in seen:
                continue
            seen.add(node)
            if not self.moves(node):
                self._still(node, required, kept)
            elif self.program.op[node] == "load":
                name = self.program.args[node][0]
                if buffers[name].kind == "scratch" and name not in done:
                    done.add(name)
                    stack += [w.number for w in buffers[name].writes]
            else:
                stack += self.program.operands(node)

    def _still(self, node: int, required: set[str], kept: dict[int, None]) -> None:
        if self.cost(node) > CHEAP:
            kept[node] = None
            return
        for x in self.program.reachable([node]):
            if self.program.op[x] == "load" and self.program.buffers[self.program.args[x][0]].kind == "scratch":
                required.add(self.program.args[x][0])

    def cost(self, node: int) -> int:
        """Operations that make a number out of what stands in buffers."""
        found = self._cost.get(node)
        if found is None:
            reach = self.program.reachable([node])
            found = self._cost[node] = sum(self.program.op[x] not in ("load", "constant") for x in reach)
        return found

    def _kept(self, kept: dict[int, None]) -> tuple[dict[int, int], list[Write]]:
        """Loads that stand for numbers, and the writes that keep them."""
        groups: dict[tuple[Variable, ...], list[int]] = {}
        for x in kept:
            over = tuple(sorted(self.program.variables(x), key=self.program.rank))
            groups.setdefault(over, []).append(x)
        aliases, writes = {}, []
        for over, some in groups.items():
            buffer = self.program.scratch(len(some) * product(v.size for v in over))
            for k, x in enumerate(some):
                index = row_major(over).times(len(some)).plus(k)
                self.program.write(buffer, over, index, x)
                aliases[x] = self.program._node("load", buffer.name, index)
        for name in dict.fromkeys(self.program.args[x][0] for x in aliases.values()):
            writes += self.program.buffers[name].writes
        return aliases, writes
