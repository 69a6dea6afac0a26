"""C++ of the functions of a program: loops over run-time sizes, in which every number is a vector of several lanes.

    static void name(const In& in)

`in` has pointers to inputs and outputs, sizes `n`, tables, scratch memory `w` and the offsets `o` of buffers in it.
A sum over an inner axis is a local variable; numbers that do not depend on a loop variable are computed before the loop.
Checked in tests/extensions/native/codegen/.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Sequence
from dataclasses import dataclass, field

from torchmbd.extensions.native.codegen.program import Buffer, Program, Write, product
from torchmbd.extensions.native.codegen.schedule import Nest, Schedule, depends
from torchmbd.extensions.native.codegen.size import AnySize, Index, Variable, loop_variables

# Numbers that are equal for all lanes (laws, the time, the step) are doubles until they are combined with numbers of lanes.
PRELUDE = """#include <cmath>
#include <cstring>
typedef double V __attribute__((vector_size(8 * LANES)));
#define PART static __attribute__((noinline)) void
static inline V spread(double x) { V y; for (int l = 0; l < LANES; l++) y[l] = x; return y; }
static inline V spread(V x) { return x; }
#define EACH(name, expression) \\
  static inline double f_##name(double a) { return expression; } \\
  static inline V f_##name(V x) { V y; for (int l = 0; l < LANES; l++) { double a = x[l]; y[l] = expression; } return y; }
#define BOTH(name, expression) \\
  static inline double f_##name(double a, double b) { return expression; } \\
  template <class A, class B> static inline V f_##name(A p, B q) { \\
    V x = spread(p), y = spread(q), r; \\
    for (int l = 0; l < LANES; l++) { double a = x[l], b = y[l]; r[l] = expression; } return r; }
EACH(sqrt, std::sqrt(a)) EACH(sin, std::sin(a)) EACH(cos, std::cos(a)) EACH(exp, std::exp(a))
EACH(abs, std::fabs(a)) EACH(log, std::log(a)) EACH(tanh, std::tanh(a))
BOTH(max, a > b ? a : (a == a ? b : a)) BOTH(min, a < b ? a : (a == a ? b : a))
BOTH(gt, a > b ? 1.0 : 0.0) BOTH(ge, a >= b ? 1.0 : 0.0) BOTH(atan2, std::atan2(a, b))
static inline double f_where(double c, double a, double b) { return c > 0.0 ? a : b; }
template <class A, class B, class C> static inline V f_where(A c, B p, C q) {
  V condition = spread(c), x = spread(p), y = spread(q), r;
  for (int l = 0; l < LANES; l++) r[l] = condition[l] > 0.0 ? x[l] : y[l];
  return r; }
"""
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


def size_text(size: AnySize) -> str:
    """A size in C++."""
    if isinstance(size, int):
        return str(size)
    terms = []
    for names, c in size.terms:
        factors = ([str(c)] if c != 1 or not names else []) + [f"n.{name}" for name in names]
        terms.append(" * ".join(factors))
    return "(" + " + ".join(terms) + ")"


@dataclass
class _Scope:
    """The body of a loop: its lines, and the C++ names of the numbers that it computes."""

    variable: Variable | None
    lines: list[str] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)


class Emitter:
    """The functions of one program. `scratch`: index in `o` and size of each scratch buffer."""

    def __init__(self, program: Program):
        self.program = program
        self.scratch: dict[str, tuple[int, AnySize]] = {}

    def function(self, name: str, schedule: Schedule, kept: set[str] = frozenset()) -> str:  # pyright: ignore
        """C++ of a function with the writes of a schedule. kept: buffers that other functions load."""
        private = schedule.private() - kept
        for buffer in sorted(schedule.written):
            self._allocate(self.program.buffers[buffer], buffer in private, schedule)
        parts, calls = [], []
        for line in self._cleared(schedule, private):
            calls.append(line)
        for k, nest in enumerate(schedule.nests):
            parts.append(_NestText(self, schedule, nest, private).text(f"{name}_{k}"))
            calls.append(f"  {name}_{k}(in);")
        body = "\n".join(calls)
        return "".join(parts) + f"static void {name}(const In& in) {{\n  const N& n = in.n;\n  (void)n;\n{body}\n}}\n"

    def layout(self) -> str:
        """C++ of a function that computes the offsets of scratch buffers and returns the number of their entries."""
        lines = [f"  o[{k}] = total; total += {size_text(size)};" for k, size in self.scratch.values()]
        count = len(self.scratch) + 1
        return (
            f"constexpr int BUFFERS = {count};\nstatic long layout(const N& n, long* o) {{\n  long total = 0;\n"
            + "\n".join(lines)
            + "\n  return total;\n}\n"
        )

    def _allocate(self, buffer: Buffer, private: bool, schedule: Schedule) -> None:
        if buffer.kind != "scratch":
            return
        size = buffer.size
        number, known = self.scratch.get(buffer.name, (len(self.scratch), None))
        if private and known is None:
            (nest,) = [n for n in schedule.nests if any(w.buffer == buffer.name for s in n.stages for w in s)]
            assert nest.variable is not None
            size = _stride(buffer.writes[0].index, nest.variable)
        self.scratch[buffer.name] = (number, known if private and known is not None else size)

    def _cleared(self, schedule: Schedule, private: set[str]) -> list[str]:
        """Lines that clear the buffers to which numbers are added."""
        lines = []
        for name in sorted(schedule.written - private):
            buffer = self.program.buffers[name]
            if buffer.kind == "scratch" and not is_fully_written(self.program, buffer):
                where = f"in.w + in.o[{self.scratch[name][0]}]"
                lines.append(f"  std::memset((void*)({where}), 0, sizeof(V) * {size_text(buffer.size)});")
        return lines


def is_fully_written(program: Program, buffer: Buffer) -> bool:
    """True if every entry of a buffer is written, and to none numbers are added by several writes."""
    entries: AnySize = 0
    for write in buffer.writes:
        entries = entries + product(v.size for v in loop_variables(write.index))
        if write.adds and not is_single_write(program, write):
            return False
    return entries == buffer.size


def is_single_write(program: Program, write: Write) -> bool:
    """True if a sum has all its terms in one write, within one iteration of the outermost loop."""
    if program.buffers[write.buffer].kind == "output":
        return not write.adds
    same = [w for w in program.buffers[write.buffer].writes if w.index == write.index]
    inner = [v for v in write.variables if not depends(write.index, v)]
    plain = all(isinstance(atom, Variable) for _, atom in write.index.terms)
    shared = len(program.buffers[write.buffer].writes) > 1 and _overlap(program, write)
    one_iteration = all(v.size in program.inner and v != write.variables[0] for v in inner)
    return len(same) == 1 and plain and not shared and one_iteration


def _overlap(program: Program, write: Write) -> bool:
    """True if other writes to the buffer may write to the same entry: unless their indices differ by constants."""
    writes = program.buffers[write.buffer].writes
    return any(w.index.terms != write.index.terms or not isinstance(w.index.offset, int) for w in writes)


def _stride(index: Index, variable: Variable) -> AnySize:
    return next(s for s, atom in index.terms if atom == variable)


class _NestText:
    """C++ of one nest."""

    def __init__(self, emitter: Emitter, schedule: Schedule, nest: Nest, private: set[str]):
        self.emitter, self.program, self.schedule = emitter, emitter.program, schedule
        self.nest, self.private = nest, private
        self.scopes = [_Scope(None)]
        self.tables: set[str] = set()
        self.count = 0
        self.buffers: set[str] = set()
        self.sums: dict[tuple[str, Index], str] = {}  # sums of private buffers in local variables

    def text(self, name: str) -> str:
        if self.nest.variable is None:
            self._stages()
        else:
            self._loop(self.nest.variable, self._stages)
        lines = self.scopes[0].lines
        head = ["  const N& n = in.n;", "  (void)n;"]
        for table in sorted(self.tables):
            head.append(f"  const int* const __restrict {table} = in.tables.{table};")
        for buffer in sorted(self.buffers):
            head.append(self._pointer(self.program.buffers[buffer]))
        return f"PART {name}(const In& in) {{\n" + "\n".join(head + lines) + "\n}\n"

    def _pointer(self, buffer: Buffer) -> str:
        if buffer.kind == "scratch":
            return f"  V* const __restrict {buffer.name} = in.w + in.o[{self.emitter.scratch[buffer.name][0]}];"
        kind = {"lanes": "const V*", "uniform": "const double*", "output": "V*"}[buffer.kind]
        return f"  {kind} const __restrict {buffer.name} = in.{buffer.name};"

    def _loop(self, variable: Variable, body: object, before: Sequence[str] = ()) -> None:
        """A loop in the innermost scope."""
        scope = _Scope(variable)
        self.scopes.append(scope)
        body()  # pyright: ignore[reportCallIssue]
        self.scopes.pop()
        i = self._name(variable)
        lines = self.scopes[-1].lines
        lines += before
        lines.append(f"  for (long {i} = 0; {i} < {size_text(variable.size)}; {i}++) {{")
        lines += [f"  {line}" for line in scope.lines]
        lines.append("  }")

    def _stages(self) -> None:
        self._clear_private()
        for stage in self.nest.stages:
            self._writes(stage, 0 if self.nest.variable is None else 1)

    def _clear_private(self) -> None:
        """Clear the private buffers to which numbers are added in this iteration."""
        written = sorted({w.buffer for stage in self.nest.stages for w in stage} & self.private)
        for name in written:
            writes = self.program.buffers[name].writes
            if self.nest.variable is not None and not is_fully_written(self.program, self.program.buffers[name]):
                self.buffers.add(name)
                size = size_text(_stride(writes[0].index, self.nest.variable))
                self.scopes[-1].lines.append(f"  std::memset((void*){name}, 0, sizeof(V) * {size});")

    def _writes(self, writes: list[Write], depth: int) -> None:
        """Writes within `depth` loops."""
        deeper: dict[Variable, list[Write]] = {}
        for write in writes:
            if len(write.variables) > depth:
                deeper.setdefault(write.variables[depth], []).append(write)
            else:
                self._store(write)
        for variable, inner_writes in deeper.items():
            self._inner(variable, inner_writes, depth)

    def _inner(self, variable: Variable, writes: list[Write], depth: int) -> None:
        """A loop over an inner variable; its sums are local variables, which are stored after the loop."""
        sums, rest = [], []
        for write in writes:
            summed = write.variables[depth:]
            is_sum = write.adds and not any(depends(write.index, v) for v in summed)
            (sums if is_sum else rest).append(write)
        names: dict[tuple[str, Index], str] = {}
        for write in sums:
            key = write.buffer, write.index
            if key not in names:
                names[key] = f"a{self._next()}"
        before = [f"  V {name} = spread(0.0);" for name in names.values()]

        def body() -> None:
            deeper: dict[Variable, list[Write]] = {}
            direct: dict[str, list[str]] = {}
            for write in [*rest, *sums]:
                if len(write.variables) > depth + 1:
                    deeper.setdefault(write.variables[depth + 1], []).append(write)
                elif write in sums:
                    direct.setdefault(names[write.buffer, write.index], []).append(self._number(write.number))
                else:
                    self._store(write)
            lines = self.scopes[-1].lines
            lines += [f"  {name} += {x};" for name, xs in direct.items() for x in xs]
            for inner, inner_writes in deeper.items():
                self._within(inner, inner_writes, depth + 1, names)

        self._loop(variable, body, before)
        lines = self.scopes[-1].lines
        for (buffer, index), name in names.items():
            write = next(w for w in sums if w.buffer == buffer and w.index == index)
            if buffer in self.private and is_single_write(self.program, write):
                self.sums[buffer, index] = name
                if not any(v.size in self.program.inner for v in loop_variables(index)):
                    continue
            op = "=" if is_single_write(self.program, write) else "+="
            lines.append(f"  {self._place(buffer, index)} {op} {name};")

    def _within(self, variable: Variable, writes: list[Write], depth: int, names: dict[tuple[str, Index], str]) -> None:
        """A loop within an inner loop: sums over both loops use the local variables of the outer one."""
        through = [w for w in writes if (w.buffer, w.index) in names and w.adds]
        others = [w for w in writes if w not in through]

        def body() -> None:
            for write in through:
                assert len(write.variables) == depth + 1, "three loops within a loop"
                x = self._number(write.number)
                self.scopes[-1].lines.append(f"  {names[write.buffer, write.index]} += {x};")

        if through:
            self._loop(variable, body)
        if others:
            self._inner(variable, others, depth)

    def _store(self, write: Write) -> None:
        x = self._number(write.number)
        op = "+=" if write.adds and not is_single_write(self.program, write) else "="
        self.scopes[-1].lines.append(f"  {self._place(write.buffer, write.index)} {op} spread({x});")

    def _next(self) -> int:
        self.count += 1
        return self.count

    def _name(self, v: Variable) -> str:
        chain = [s.variable for s in self.scopes[1:]]
        return f"i{chain.index(v) if v in chain else len(chain)}"

    def _number(self, number: int) -> str:
        """The C++ name of a number; lines that compute it are added if it has none."""
        for node in self.schedule.reach(number, ChainMap(*(s.names for s in self.scopes))):
            self._compute(node)
        return self._name_of(number)

    def _name_of(self, node: int) -> str:
        node = self.schedule.aliases.get(node, node)
        return next(s.names[node] for s in self.scopes if node in s.names)

    def _compute(self, node: int) -> None:
        program = self.program
        op, args = program.op[node], program.args[node]
        if op == "constant":
            self.scopes[0].names[node] = _constant(args[0])
            return
        chain = [s.variable for s in self.scopes]
        depth = max((chain.index(v) for v in program.variables(node)), default=0)
        scope = self.scopes[depth]
        if op == "load":
            summed = self.sums.get((args[0], args[1]))
            if summed is not None and not any(v.size in program.inner for v in loop_variables(args[1])):
                scope.names[node] = summed
                return
            text = self._place(*args)
        else:
            text = _expression(op, [self._name_of(a) for a in args])
        name = f"v{self._next()}"
        scope.names[node] = name
        scope.lines.append(f"  const auto {name} = {text};")

    def _place(self, buffer: str, index: Index) -> str:
        self.buffers.add(buffer)
        skipped = self.nest.variable if buffer in self.private else None
        terms = [self._term(s, atom) for s, atom in index.terms if atom != skipped or skipped is None]
        if index.offset != 0 or not terms:
            terms.append(size_text(index.offset))
        return f"{buffer}[{' + '.join(terms)}]"

    def _term(self, stride: AnySize, atom: object) -> str:
        if isinstance(atom, Variable):
            text = self._name(atom)
        else:
            self.tables.add(atom.table)  # pyright: ignore[reportAttributeAccessIssue]
            inner = [self._term(s, a) for s, a in atom.index.terms]  # pyright: ignore[reportAttributeAccessIssue]
            offset = atom.index.offset  # pyright: ignore[reportAttributeAccessIssue]
            inner += [size_text(offset)] if offset != 0 or not inner else []
            text = f"{atom.table}[{' + '.join(inner)}]"  # pyright: ignore[reportAttributeAccessIssue]
        return text if stride == 1 else f"{size_text(stride)} * {text}"


def _constant(x: float) -> str:
    return repr(x) if math.isfinite(x) else "NAN" if x != x else "HUGE_VAL" if x > 0 else "(-HUGE_VAL)"


def _expression(op: str, args: Sequence[str]) -> str:
    if op == "neg":
        return f"-{args[0]}"
    if op in _INFIX:
        return f"{args[0]} {_INFIX[op]} {args[1]}"
    return f"f_{op}({', '.join(args)})"
