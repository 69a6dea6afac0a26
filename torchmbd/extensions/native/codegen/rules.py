"""Derivatives of the operations of a tape (scalars.py) in reverse mode.

Checked in tests/extensions/native/codegen/test_reverse.py.
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, section 3.2.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile

from torchmbd.extensions.native.codegen.scalars import Tape

Conditions = tuple[tuple[int, bool], ...]  # pairs (condition, required value) of the branches that use a number
# A cotangent of zero gives cotangents of zero, also where arguments are not finite.
PLAIN = (
    "add",
    "sub",
    "neg",
    "where",
)
Rule = Callable[[Tape, int, int, tuple], tuple]


def _mul(t: Tape, bar: int, _: int, args: tuple) -> tuple:
    a, b = args
    return t.call("mul", bar, b), t.call("mul", bar, a)


def _div(t: Tape, bar: int, out: int, args: tuple) -> tuple:
    first = t.call("div", bar, args[1])
    return first, t.call("neg", t.call("mul", first, out))


def _sqrt(t: Tape, bar: int, out: int, _: tuple) -> tuple:
    return (t.call("div", t.call("mul", t.constant(0.5), bar), out),)


def _abs(t: Tape, bar: int, _: int, args: tuple) -> tuple:
    zero, a = t.zero, args[0]
    return (t.call("mul", bar, t.call("sub", t.call("gt", a, zero), t.call("gt", zero, a))),)


def _tanh(t: Tape, bar: int, out: int, _: tuple) -> tuple:
    return (t.call("mul", bar, t.call("sub", t.unit, t.call("mul", out, out))),)


def _chosen(order: Callable[[int, int], tuple[int, int]]) -> Rule:
    """The rule of max and min; equal arguments get half of the cotangent each, as in torch."""

    def rule(t: Tape, bar: int, _: int, args: tuple) -> tuple:
        more, less = order(*args)
        half = t.call("mul", t.constant(0.5), bar)
        wins, draws = t.call("gt", more, less), t.call("ge", more, less)

        def part(condition: int, other: int) -> int:
            return t.call("where", condition, bar, other)

        first = part(wins, t.call("where", draws, half, t.zero))
        return first, t.call("sub", bar, first)

    return rule


def _atan2(t: Tape, bar: int, _: int, args: tuple) -> tuple:
    y, x = args
    square = t.call("add", t.call("mul", x, x), t.call("mul", y, y))
    share = t.call("div", bar, square)
    return t.call("mul", share, x), t.call("neg", t.call("mul", share, y))


def _where(t: Tape, bar: int, _: int, args: tuple) -> tuple:
    c = args[0]
    return t.zero, t.call("where", c, bar, t.zero), t.call("where", c, t.zero, bar)


# Cotangents of the arguments of an operation whose result has the cotangent `bar`: f(tape, bar, result, arguments).
RULES: dict[str, Rule] = {
    "add": lambda t, bar, out, args: (bar, bar),
    "sub": lambda t, bar, out, args: (bar, t.call("neg", bar)),
    "neg": lambda t, bar, out, args: (t.call("neg", bar),),
    "mul": _mul,
    "div": _div,
    "sqrt": _sqrt,
    "abs": _abs,
    "tanh": _tanh,
    "sin": lambda t, bar, out, args: (t.call("mul", bar, t.call("cos", args[0])),),
    "cos": lambda t, bar, out, args: (t.call("neg", t.call("mul", bar, t.call("sin", args[0]))),),
    "exp": lambda t, bar, out, args: (t.call("mul", bar, out),),
    "log": lambda t, bar, out, args: (t.call("div", bar, args[0]),),
    "max": _chosen(lambda a, b: (a, b)),
    "min": _chosen(lambda a, b: (b, a)),
    "gt": lambda t, bar, out, args: (t.zero, t.zero),
    "ge": lambda t, bar, out, args: (t.zero, t.zero),
    "atan2": _atan2,
    "where": _where,
}


def common_conditions(a: Conditions, b: Conditions) -> Conditions:
    """The common first conditions of both."""
    return tuple(x for x, _ in takewhile(lambda both: both[0] == both[1], zip(a, b, strict=False)))


def zero_unless(tape: Tape, conditions: Conditions, bar: int) -> int:
    """`bar` where all conditions hold, else zero: in an unused branch, zero times a derivative may be nan."""
    for c, holds in conditions:
        bar = tape.call("where", c, bar, tape.zero) if holds else tape.call("where", c, tape.zero, bar)
    return bar
