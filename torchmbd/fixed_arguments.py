"""Objects whose arguments cannot be set after construction, because the constructor has made what follows from them.

    body.modes = 10
    InputError: body.modes = 10: must be an argument of FlexibleBody(...), because ... Try: FlexibleBody(..., modes=...)

Tensors and modules that an object reads at each use, such as the mass of a rigid body, can be set; torch registers parameters.
Checked in tests/test_fixed_arguments.py.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar

from torch import nn

from torchmbd.errors import InputError, argument_names

_MADE = "_made"  # False while the constructor runs


class FixedArguments:
    """Base of such classes.

    free_arguments   numbers that the object reads at each use
    """

    free_arguments: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            constructed: Any = cls
            constructed.__init__ = _construct(constructed.__init__)

    def __setattr__(self, name: str, value: Any) -> None:
        if vars(self).get(_MADE) and self._is_fixed(name, value):
            own, kind = vars(self).get("name"), type(self).__name__
            raise InputError(
                name if own is None else (own, name),
                value,
                f"an argument of {kind}(...), because an object keeps those that it was made with",
                hint=self._remedy(name),
            )
        super().__setattr__(name, value)

    def _remedy(self, argument: str) -> str:
        """The remedy in the error: how an object with another argument is made."""
        return f"{type(self).__name__}(..., {argument}=...)"

    def _is_fixed(self, name: str, value: Any) -> bool:
        read = ("_parameters", "_buffers", "_modules")  # of torch.nn.Module
        if name in self.free_arguments or any(name in vars(self).get(members, ()) for members in read):
            return False
        return name in argument_names(type(self)) and not isinstance(value, nn.Parameter)


def fix_arguments(x: FixedArguments) -> None:
    """Fix the arguments of an object that is made without its constructor."""
    vars(x)[_MADE] = True


def _construct(construct: Callable[..., None]) -> Callable[..., None]:
    """A constructor after which arguments are fixed; one that a subclass calls leaves that to its own."""

    @functools.wraps(construct)
    def constructed(self: Any, *arguments: Any, **options: Any) -> None:
        outermost = _MADE not in vars(self)
        vars(self).setdefault(_MADE, False)
        construct(self, *arguments, **options)
        if outermost:
            fix_arguments(self)

    return constructed
