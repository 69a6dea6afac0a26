"""The loops of a function of a program.

    Nest    a loop over one axis, such as all bodies; all its stages are computed for one body before the next body
    stage   writes that do not depend on each other; loops over inner axes, such as modes, are within a stage

A stage may load the results of earlier stages of the same nest if they belong to the same body (`Buffer.size` = axis * stride).
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, field

from torchmbd.extensions.native.codegen.program import Program, Write
from torchmbd.extensions.native.codegen.size import Index, Size, Variable, loop_variables


@dataclass
class Nest:
    """A loop over a variable (None: no loop) and its stages."""

    variable: Variable | None
    stages: list[list[Write]] = field(default_factory=list)

    def put(self, write: Write, stage: int) -> None:
        while len(self.stages) <= stage:
            self.stages.append([])
        self.stages[stage].append(write)


class Schedule:
    """The nests of a function that computes the writes `roots` and all writes that they need.

    complete  buffers that are complete when the function is called
    aliases   number -> load from such a buffer in its place
    """

    def __init__(
        self, program: Program, roots: Iterable[Write], complete: set[str], aliases: dict[int, int] | None = None
    ):
        self.program, self.complete, self.aliases = program, complete, aliases or {}
        self.nests: list[Nest] = []
        self._loads: dict[int, frozenset[int]] = {}
        self.writes = self._needed(roots)
        self.written = {w.buffer for w in self.writes}
        self._arrange()

    def loads(self, number: int) -> list[int]:
        """The loads that a number needs, in order."""
        for node in self.reach(number, self._loads):
            of_operands = (self._loads[a] for a in self.operands(node))
            is_load = self.program.op[node] == "load"
            self._loads[node] = frozenset((node,)) if is_load else frozenset().union(*of_operands)
        return sorted(self._loads[self.aliases.get(number, number)])

    def reach(self, number: int, without: Container[int] = ()) -> list[int]:
        """All numbers that a number needs, arguments first, with aliases in place of numbers.

        without  numbers that are computed already, with all their arguments
        """
        needed: dict[int, None] = {}
        stack = [self.aliases.get(number, number)]
        while stack:
            node = stack[-1]
            known = node in needed or node in without
            missing = [] if known else [a for a in self.operands(node) if a not in needed and a not in without]
            if missing:
                stack += missing
                continue
            stack.pop()
            if not known:
                needed[node] = None
        return list(needed)

    def operands(self, node: int) -> list[int]:
        """Arguments of a number, or their aliases."""
        return [self.aliases.get(a, a) for a in self.program.operands(node)]

    def _needed(self, roots: Iterable[Write]) -> list[Write]:
        buffers = self.program.buffers
        writes, known, stack = [], set(), list(roots)
        while stack:
            write = stack.pop()
            writes.append(write)
            for node in self.loads(write.number):
                name = self.program.args[node][0]
                if buffers[name].kind == "scratch" and name not in self.complete and name not in known:
                    known.add(name)
                    stack += buffers[name].writes
        return sorted(dict.fromkeys(writes), key=lambda w: w.number)

    def _arrange(self) -> None:
        at: dict[str, list[tuple[int, int]]] = {}  # nest and stage of each write to a buffer
        for write in self._ordered():
            variable = write.variables[0] if write.variables else None
            deps = {self.program.args[x][0] for x in self.loads(write.number)} & self.written
            local = {name for name in deps if self._is_local(name, variable, write)}
            first = max((n + (name not in local) for name in deps for n, _ in at[name]), default=0)
            fits = [k for k in range(first, len(self.nests)) if self.nests[k].variable == variable]
            k = fits[0] if fits else len(self.nests)
            if not fits:
                self.nests.append(Nest(variable))
            stage = max((s + 1 for name in deps for n, s in at[name] if n == k), default=0)
            self.nests[k].put(write, stage)
            at.setdefault(write.buffer, []).append((k, stage))

    def _ordered(self) -> list[Write]:
        """The writes, each after all writes to the buffers that it loads."""
        counts: dict[str, int] = {}
        for w in self.writes:
            counts[w.buffer] = counts.get(w.buffer, 0) + 1
        waiting = {
            i: {self.program.args[x][0] for x in self.loads(w.number)} & self.written for i, w in enumerate(self.writes)
        }
        result, remaining = [], list(range(len(self.writes)))
        while remaining:
            later = []
            for i in remaining:
                if any(counts[name] for name in waiting[i]):
                    later.append(i)
                else:
                    result.append(self.writes[i])
                    counts[self.writes[i].buffer] -= 1
            assert len(later) < len(remaining), "buffers load each other"
            remaining = later
        return result

    def _is_local(self, name: str, variable: Variable | None, write: Write) -> bool:
        """True if a write loads from a buffer only numbers that the same iteration of its loop has written."""
        indices = [w.index for w in self.program.buffers[name].writes]
        indices += [self.program.args[x][1] for x in self.loads(write.number) if self.program.args[x][0] == name]
        return variable is not None and all(self.is_of_iteration(name, variable, index) for index in indices)

    def is_of_iteration(self, name: str, variable: Variable, index: Index) -> bool:
        """True if an index of a buffer [variable, rest] belongs to the current iteration of a loop."""
        size = self.program.buffers[name].size
        strides = [s for s, atom in index.terms if atom == variable]
        others = [a for _, a in index.terms if a != variable]
        if len(strides) != 1 or not isinstance(size, Size) or strides[0] * variable.size != size:
            return False
        if not all(isinstance(a, Variable) and a.size in self.program.inner for a in others):
            return False
        stride, offset = strides[0], index.offset
        return isinstance(offset, int) and offset >= 0 and not (isinstance(stride, int) and offset >= stride)

    def private(self) -> set[str]:
        """Buffers whose contents are used only in the iteration of a loop that writes them."""
        where: dict[str, set[int]] = {}
        shared = set()
        for k, nest in enumerate(self.nests):
            for write in (w for stage in nest.stages for w in stage):
                where.setdefault(write.buffer, set()).add(k)
                if nest.variable is None or not self.is_of_iteration(write.buffer, nest.variable, write.index):
                    shared.add(write.buffer)
                for x in self.loads(write.number):
                    name, index = self.program.args[x]
                    if name in self.written:
                        where.setdefault(name, set()).add(k)
                        if nest.variable is None or not self.is_of_iteration(name, nest.variable, index):
                            shared.add(name)
        scratch = {name for name in self.written if self.program.buffers[name].kind == "scratch"}
        return {name for name in scratch - shared if len(where[name]) == 1}


def depends(index: Index, variable: Variable) -> bool:
    """True if an index depends on a variable."""
    return variable in loop_variables(index)
