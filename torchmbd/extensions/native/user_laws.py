"""Laws of users as scalar operations, which can be compiled, and are part of the key of compiled code.

    f(s, s', t)    traced to operators, each a scalar operation of a tape (codegen/scalars.py)
    df/ds, df/ds'  by differentiating the tape (codegen/scalar_derivatives.py), unless the law states its own `slopes`

A law is traced for every simulation, so closures and attributes are never stale.
A law with branches in Python, with unknown operators, or with other libraries than torch cannot be traced: native code calls it
back (`CallbackLaw`). A traced law is compared with the original at random points.
Checked in tests/extensions/native/test_user_laws.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.native.codegen.scalar_derivatives import derivative
from torchmbd.extensions.native.codegen.scalars import Tape, Untraceable
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.forces.action import law_slopes
from torchmbd.multibody.forces.feedback import Control, Port
from torchmbd.multibody.forces.laws import Scaled, data_fields
from torchmbd.multibody.forces.parametric_law import ParametricLaw, is_library_law

_INPUTS = ("s", "rate", "t")
_TORCH: dict[str, Callable[..., Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "neg": torch.neg,
    "max": torch.maximum,
    "min": torch.minimum,
    "gt": lambda a, b: (a > b).to(a.dtype),
    "ge": lambda a, b: (a >= b).to(a.dtype),
    "where": lambda c, a, b: torch.where(c > 0.0, a, b),
}


@dataclass(frozen=True)
class TracedLaw:
    """A law as operations on numbers 0 (s), 1 (s'), 2 (t), 3, 4, ...

    operations  name and arguments of the numbers 3, 4, ...; arguments are numbers, or the value of a "constant"
    outputs     numbers of f, df/ds, df/ds'
    center      middle of the range of an angle
    """

    operations: tuple[tuple[str, tuple], ...]
    outputs: tuple[int, int, int]
    center: float = 0.0

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return self._run(s, rate, t)[0]

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives with respect to s and s'."""
        _, by_s, by_rate = self._run(s, rate, t)
        return by_s, by_rate

    def _run(self, s: Tensor, rate: Tensor, t: Tensor) -> list[Tensor]:
        numbers = [s, rate, t + torch.zeros_like(s)]
        for op, args in self.operations:
            if op == "constant":
                numbers.append(torch.full_like(s, args[0]))
            else:
                f = _TORCH.get(op) or getattr(torch, op)
                numbers.append(f(*(numbers[a] for a in args)))
        return [numbers[i] for i in self.outputs]


def _is_native(law: Any) -> bool:
    """True if native code takes a law as it is: of this library, traced, or one of a user that names its data."""
    return isinstance(law, TracedLaw) or is_library_law(law) or (bool(data_fields(law)) and not isinstance(law, Scaled))


def traceable_part(law: Any) -> Any:
    """A law of this library as it is, others traced; Untraceable where that is not possible."""
    if isinstance(law, (ParametricLaw, Scaled)):
        return replace(law, law=traceable_part(law.law))
    return law if _is_native(law) else trace_law(law)


def native_law(law: Any) -> Any:
    """The law in a form for native code: of this library, traced, or called back. Untraceable for a law with design variables
    that cannot be traced."""
    if isinstance(law, Port) or _is_native(law):
        return law
    if isinstance(law, ParametricLaw):
        return traceable_part(law)
    try:
        return traceable_part(law)
    except Untraceable:
        return Port(CallbackLaw(law), ((0, False), (1, True)), 0, center=float(getattr(law, "center", 0.0)))


class CallbackLaw(Control):
    """A law of a user as a controller with the inputs s, s', t, without parameters; it is called with all lanes at once."""

    def __init__(self, law: Callable[..., Tensor]):
        self.name, self.law, self.inputs, self.outputs, self.variables = "", law, 3, 1, None

    @property
    def label(self) -> str:
        return f"law {self.law!r}"

    def at(self, p: Tensor, x: Tensor, t: Any) -> Tensor:
        s, rate = x[:2, None, None]
        f = self.law(s, rate, t)
        if not isinstance(f, Tensor) or f.shape != s.shape or f.dtype != s.dtype:
            shown = f"{f.dtype} {list(f.shape)}" if isinstance(f, Tensor) else repr(f)
            raise InputError(
                self.label,
                allowed=f"must give {s.dtype} {list(s.shape)}",
                state=f"gives {shown} at t = {float(t):.6g} s",
            )
        return f[0]

    def with_jacobian(self, p: Tensor, x: Tensor, t: Any) -> tuple[Tensor, Tensor]:
        s, rate = x[:2, None, None]
        by = law_slopes(self.law, s, rate, t)
        return self.at(p, x, t), torch.stack([*(y.expand(1, 1, x.shape[1])[0, 0] for y in by), x[2] * 0.0])[None]


def trace_law(law: Any) -> TracedLaw:
    """A law as scalar operations; Untraceable, with the reason, if it cannot be traced."""
    slopes = getattr(law, "slopes", None)

    def outputs_of(s: Tensor, rate: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        return (law(s, rate, t), *(slopes(s, rate, t) if slopes is not None else ()))

    tape = Tape()
    shapes = {"s": (1, 1, 1), "rate": (1, 1, 1), "t": ()}

    def trace() -> tuple[TracedLaw, bool]:
        traced = tape.trace(outputs_of, *(tape.inputs(name, *shapes[name]) for name in _INPUTS))
        outputs = [int(x.ravel()[0]) for x in traced]
        if slopes is None:
            outputs += [derivative(tape, outputs[0], tape.inputs(name, 1)[0]) for name in ("s", "rate")]
        result = _numbered(tape, outputs, float(getattr(law, "center", 0.0)))
        return result, _same(outputs_of, result)

    try:
        result, same = outside_transforms(trace)  # of torch.func, which would wrap the random numbers of the comparison
    except Exception as error:  # a law may do anything
        raise Untraceable(str(error).partition("\n")[0] or repr(error)) from error
    if not same:
        raise Untraceable("written out it gives other numbers: it leaves torch, or float64")
    return result


def _same(law: Callable[..., tuple[Tensor, ...]], trace: TracedLaw) -> bool:
    """True if a law, with its slopes if it states them, and the traced one agree at random points small and large.

    They differ where the law uses another library than torch, whose results are traced as constants.
    """
    make = torch.Generator().manual_seed(1)
    for size in (1e-3, 1.0, 1.0, 30.0, 1e3):
        s, rate, t = (size * (2.0 * torch.rand(1, 1, 16, generator=make, dtype=torch.float64) - 1.0) for _ in range(3))
        t = t[0, 0, 0].abs()
        with torch.no_grad():
            expected = law(s, rate, t)
            for x, y in zip((trace(s, rate, t), *trace.slopes(s, rate, t)), expected, strict=False):
                if y.dtype != x.dtype or not torch.allclose(x, y, rtol=1e-9, atol=1e-14, equal_nan=True):
                    return False
    return True


def _numbered(tape: Tape, outputs: list[int], center: float) -> TracedLaw:
    """The operations that the outputs need, in their order on the tape, renumbered."""
    needed, stack = set(), list(outputs)
    while stack:
        node = stack.pop()
        if node not in needed:
            needed.add(node)
            stack += [] if tape.op[node] in ("input", "constant") else tape.args[node]
    number, operations = {}, []
    for node in sorted(needed):  # arguments precede the operations that use them
        op, args = tape.op[node], tape.args[node]
        if op == "input":
            number[node] = _INPUTS.index(args[0])
            continue
        number[node] = len(_INPUTS) + len(operations)
        operations.append((op, args if op == "constant" else tuple(number[a] for a in args)))
    f, by_s, by_rate = (number[node] for node in outputs)
    return TracedLaw(tuple(operations), (f, by_s, by_rate), center)
