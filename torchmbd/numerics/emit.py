"""C++ of straight-line code: functions of a tape (scalars.py) whose numbers are eight lanes side by side.

    void name(const In& in, Room w, Room out)     numbers V: eight doubles; w: room for what lives longer than one part


Long functions are written in parts of some hundred statements, for compilers need more than linear time in their length.
Operations come in the order in which the results need them, so that few numbers live at once.
Checked in tests/numerics/test_scalars.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from torchmbd.numerics.scalars import Tape

PART = 400  # statements
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}

# Numbers that are the same for all lanes (laws, the time, the step) stay doubles until they meet others.
PRELUDE = """#include <cmath>
#include <cstring>
typedef double V __attribute__((vector_size(64)));
typedef V* Room;
#define PART static __attribute__((noinline)) void
#define WHOLE static void
#define TABLE static const int
static inline V spread(double x) { return V{x, x, x, x, x, x, x, x}; }
static inline V spread(V x) { return x; }
#define EACH(name, expression) \\
  static inline double f_##name(double a) { return expression; } \\
  static inline V f_##name(V x) { V y; for (int l = 0; l < 8; l++) { double a = x[l]; y[l] = expression; } return y; }
#define BOTH(name, expression) \\
  static inline double f_##name(double a, double b) { return expression; } \\
  template <class A, class B> static inline V f_##name(A p, B q) { \\
    V x = spread(p), y = spread(q), r; \\
    for (int l = 0; l < 8; l++) { double a = x[l], b = y[l]; r[l] = expression; } return r; }
FUNCTIONS
static inline double f_where(double c, double a, double b) { return c > 0.0 ? a : b; }
template <class A, class B, class C> static inline V f_where(A c, B p, C q) {
  V condition = spread(c), x = spread(p), y = spread(q), r;
  for (int l = 0; l < 8; l++) r[l] = condition[l] > 0.0 ? x[l] : y[l];
  return r; }
"""
_FUNCTIONS = """EACH(sqrt, std::sqrt(a)) EACH(sin, std::sin(a)) EACH(cos, std::cos(a)) EACH(exp, std::exp(a))
EACH(abs, std::fabs(a)) EACH(log, std::log(a)) EACH(tanh, std::tanh(a))
BOTH(max, a > b ? a : (a == a ? b : a)) BOTH(min, a < b ? a : (a == a ? b : a))
BOTH(gt, a > b ? 1.0 : 0.0) BOTH(ge, a >= b ? 1.0 : 0.0) BOTH(atan2, std::atan2(a, b))"""
PRELUDE = PRELUDE.replace("FUNCTIONS", _FUNCTIONS)


class Emitter:
    """Writes functions of one tape; `arrays` names the expression of each input array, e.g. "in.x"."""

    def __init__(self, tape: Tape, arrays: dict[str, str]):
        self.tape, self.arrays = tape, arrays
        self.room = 0  # of w, for the largest function

    def function(self, name: str, outputs: Sequence[int], known: dict[int, str] | None = None) -> str:
        """C++ of a function that computes `outputs`; `known`: expressions of numbers that need not be computed."""
        known = known or {}
        order = self.order(outputs, known)
        parts = [order[i : i + PART] for i in range(0, len(order), PART)] or [[]]
        part_of = {node: k for k, part in enumerate(parts) for node in part}
        last = dict(part_of)
        for node in order:
            for a in self.tape.args[node]:
                if a in part_of:
                    last[a] = max(last[a], part_of[node])
        wanted: dict[int, list[int]] = {}
        for i, node in enumerate(outputs):
            wanted.setdefault(node, []).append(i)
        places, text = _Places(), []
        for k, part in enumerate(parts):
            lines = []
            for node in part:
                lines.append(f"  const auto t{node} = {self._expression(node, known, places, part_of, k)};")
                if last[node] > k:
                    lines.append(f"  w[{places.take(node, last[node])}] = spread(t{node});")
                lines += [f"  out[{i}] = spread(t{node});" for i in wanted.get(node, ())]
            places.free(k)
            text.append(f"PART {name}_{k}(const In& in, Room w, Room out) {{\n")
            text.append("\n".join(lines) + "\n}\n")
        self.room = max(self.room, places.size)
        calls = "".join(f"  {name}_{k}(in, w, out);\n" for k in range(len(parts)))
        rest = [(i, n) for n, where in wanted.items() if n not in part_of for i in where]
        calls += "".join(f"  out[{i}] = spread({self._leaf(n, known)});\n" for i, n in rest)
        return "".join(text) + f"WHOLE {name}(const In& in, Room w, Room out) {{\n{calls}}}\n"

    def order(self, outputs: Iterable[int], known: dict[int, str] | None = None) -> list[int]:
        """The operations that the outputs need, arguments first."""
        tape, done, order = self.tape, set(known or ()), []
        for output in outputs:
            stack = [output]
            while stack:
                node = stack[-1]
                if node in done or self._is_leaf(node):
                    stack.pop()
                    continue
                missing = [a for a in tape.args[node] if a not in done and not self._is_leaf(a)]
                if missing:
                    stack += reversed(missing)
                    continue
                stack.pop()
                done.add(node)
                order.append(node)
        return order

    def _is_leaf(self, node: int) -> bool:
        return self.tape.op[node] in ("input", "constant")

    def _leaf(self, node: int, known: dict[int, str]) -> str:
        if node in known:
            return known[node]
        if self.tape.op[node] == "constant":
            x = self.tape.args[node][0]
            return repr(x) if math.isfinite(x) else "NAN" if x != x else "HUGE_VAL" if x > 0 else "(-HUGE_VAL)"
        array, i = self.tape.args[node]
        return f"{self.arrays[array]}[{i}]"

    def _expression(self, node: int, known: dict[int, str], places: _Places, part_of: dict[int, int], part: int) -> str:
        def operand(a: int) -> str:
            if a in known or self._is_leaf(a):
                return self._leaf(a, known)
            return f"t{a}" if part_of[a] == part else f"w[{places.of[a]}]"

        op, args = self.tape.op[node], [operand(a) for a in self.tape.args[node]]
        if op == "neg":
            return f"-{args[0]}"
        if op in _INFIX:
            return f"{args[0]} {_INFIX[op]} {args[1]}"
        return f"f_{op}({', '.join(args)})"


class _Places:
    """Places in w: taken from one part of a function to another, then used again."""

    def __init__(self) -> None:
        self.of: dict[int, int] = {}
        self.size = 0
        self._empty: list[int] = []
        self._ends: dict[int, list[int]] = {}

    def take(self, node: int, until: int) -> int:
        """A place for a number that is needed until a part."""
        if self._empty:
            place = self._empty.pop()
        else:
            place, self.size = self.size, self.size + 1
        self.of[node] = place
        self._ends.setdefault(until, []).append(place)
        return place

    def free(self, part: int) -> None:
        """After a part: what was needed until there."""
        self._empty += self._ends.pop(part, [])
