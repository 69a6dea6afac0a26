"""Forward mode of torch, for one thread at a time: its level is a global of the process.

The package calls these functions, and not those of torch.func. They take the lock of exclusive functions (module_call.py),
which f may call: with a lock of their own two threads could wait for each other.
Checked in tests/math/test_forward_mode.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from torchmbd.math.module_call import alone


def jvp(f: Callable[..., Any], primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> Any:
    """Return f(*primals) and its derivative along the tangents, as torch.func.jvp does."""
    with alone():
        return torch.func.jvp(f, primals, tangents)


def jacfwd(f: Callable[..., Any], argnums: int = 0) -> Callable[..., Any]:
    """Return the function that torch.func.jacfwd returns, for one thread at a time."""
    jacobian = torch.func.jacfwd(f, argnums=argnums)

    def of_one_thread(*args: Any) -> Any:
        with alone():
            return jacobian(*args)

    return of_one_thread
