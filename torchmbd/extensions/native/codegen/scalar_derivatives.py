"""Derivatives of scalar code (scalars.py) in forward mode: further operations on the same tape.

The derivative of `where`, `max` and `min` is that of the selected argument.
Checked in tests/extensions/native/test_user_laws.py.
"""

from __future__ import annotations

from torchmbd.extensions.native.codegen.scalars import Tape


def derivative(tape: Tape, output: int, by: int) -> int:
    """The derivative of a number of the tape by an input."""
    known = {by: tape.unit}
    stack = [output]
    while stack:
        node = stack[-1]
        if node in known or tape.op[node] in ("input", "constant", "gt", "ge"):
            known.setdefault(node, tape.zero)
            stack.pop()
            continue
        missing = [a for a in tape.args[node] if a not in known]
        stack += missing
        if not missing:
            known[node] = _slope(tape, node, [known[a] for a in tape.args[node]])
            stack.pop()
    return known[output]


def _slope(tape: Tape, node: int, slopes: list[int]) -> int:
    """The derivative of an operation from those of its arguments."""
    call, op, args = tape.call, tape.op[node], tape.args[node]
    if op in ("add", "sub", "neg"):
        return call(op, *slopes)
    if op == "mul":
        return call("add", call("mul", slopes[0], args[1]), call("mul", args[0], slopes[1]))
    if op == "div":
        return call("div", call("sub", slopes[0], call("mul", node, slopes[1])), args[1])
    if op == "where":
        return call("where", args[0], *slopes[1:])
    if op in ("max", "min"):
        return call("where", call("gt", *(args if op == "max" else args[::-1])), *slopes)
    if op == "atan2":
        square = call("add", call("mul", args[0], args[0]), call("mul", args[1], args[1]))
        turned = call("sub", call("mul", args[1], slopes[0]), call("mul", args[0], slopes[1]))
        return call("div", turned, square)
    return call("mul", slopes[0], _UNARY[op](tape, node, args[0]))


# Slope of y = op(x).
_UNARY = {
    "sin": lambda tape, y, x: tape.call("cos", x),
    "cos": lambda tape, y, x: tape.call("neg", tape.call("sin", x)),
    "exp": lambda tape, y, x: y,
    "log": lambda tape, y, x: tape.call("div", tape.unit, x),
    "tanh": lambda tape, y, x: tape.call("sub", tape.unit, tape.call("mul", y, y)),
    "sqrt": lambda tape, y, x: tape.call("div", tape.constant(0.5), y),
    "abs": lambda tape, y, x: tape.call("sub", tape.call("gt", x, tape.zero), tape.call("gt", tape.zero, x)),
}
