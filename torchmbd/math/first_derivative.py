"""Custom operators that are first derivatives of others: an error instead of a wrong second derivative."""

from __future__ import annotations

from typing import Any

from torch.autograd import Function


class FirstDerivative(Function):
    """A first derivative as a torch function; its own derivative is a NotImplementedError.

    of   name of the function that would be differentiated twice
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
