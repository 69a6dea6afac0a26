"""Classes whose arguments are constants: a tensor with a gradient among them would lose it.

Functions among the arguments are called on motions, and checked there (functions.py, integrate/phases/events.py).

Checked in tests/contracts/test_responses.py.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, Self

from torchmbd.math.gradients import refuse_gradients


class ConstantArguments:
    """A class whose arguments are constants: InputError names an argument that contains a tensor with a gradient."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        names = (f.name for f in fields(cls)) if is_dataclass(cls) else ()
        for name, x in (*zip(names, args, strict=False), *kwargs.items()):
            refuse_gradients(f"{name} of {cls.__name__}", x, "constants")
        return super().__new__(cls)
