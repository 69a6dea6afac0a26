"""A program run in Python, one number after another: what tests compare C++ and derivatives with."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from torchmbd.extensions.native.codegen.program import Program, Write
from torchmbd.extensions.native.codegen.scalars import BINARY, TERNARY, UNARY
from torchmbd.extensions.native.codegen.size import Index, Variable, evaluated


class Interpreter:
    """Runs writes for given sizes, tables and inputs."""

    def __init__(
        self, program: Program, sizes: Mapping[str, int], tables: Mapping[str, Any], inputs: Mapping[str, Any]
    ):
        self.program, self.sizes, self.tables = program, sizes, tables
        self.memory: dict[str, np.ndarray] = {
            name: np.asarray(x, dtype=np.float64).ravel() for name, x in inputs.items()
        }

    def run(self, writes: Iterable[Write], outputs: Mapping[str, int]) -> dict[str, np.ndarray]:
        """What outputs of some lengths hold after the writes."""
        for name, n in outputs.items():
            self.memory[name] = np.zeros(n)
        for write in writes:
            self._write(write)
        return {name: self.memory[name] for name in outputs}

    def _write(self, write: Write) -> None:
        for values in itertools.product(*(range(evaluated(v.size, self.sizes)) for v in write.variables)):
            at = dict(zip(write.variables, values, strict=True))
            memo: dict[int, float] = {}
            for node in self.program.reachable([write.number]):
                memo[node] = self._number(node, at, memo)
            i = self._index(write.index, at)
            self.memory[write.buffer][i] = memo[write.number] + (self.memory[write.buffer][i] if write.adds else 0.0)

    def _number(self, node: int, at: dict[Variable, int], memo: dict[int, float]) -> float:
        op, args = self.program.op[node], self.program.args[node]
        if op == "constant":
            return args[0]
        if op == "load":
            return float(self._buffer(args[0])[self._index(args[1], at)])
        f: Any = UNARY.get(op) or BINARY.get(op) or TERNARY[op]
        try:
            return f(*(memo[a] for a in args))
        except (ArithmeticError, ValueError):  # as processors have it
            return math.nan

    def _buffer(self, name: str) -> np.ndarray:
        if name not in self.memory:
            buffer = self.program.buffers[name]
            self.memory[name] = np.zeros(evaluated(buffer.size, self.sizes))
            for write in buffer.writes:
                self._write(write)
        return self.memory[name]

    def _index(self, index: Index, at: dict[Variable, int]) -> int:
        total = evaluated(index.offset, self.sizes)
        for stride, atom in index.terms:
            i = at[atom] if isinstance(atom, Variable) else self.tables[atom.table][self._index(atom.index, at)]
            total += evaluated(stride, self.sizes) * int(i)
        return total
