"""Custom operators that are first derivatives themselves: they have none, and say so instead of giving zero."""

from __future__ import annotations

from typing import Any

from torch.autograd import Function


class FirstDerivative(Function):
    """A torch function that derivatives of another are made of; differentiating it again is refused by name.

    of   what would be differentiated twice
    """

    of: str

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        """Keep nothing."""

    @classmethod
    def jvp(cls, ctx: Any, *_: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise NotImplementedError(
            f"second derivatives of {cls.of} are not provided; use finite differences of gradients"
        )

    @classmethod
    def backward(cls, ctx: Any, *_: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        cls.jvp(ctx)
