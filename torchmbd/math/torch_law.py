"""Whether a law of a user can be differentiated by torch: laws of SciPy or NumPy, such as splines, are refused by name.

A law that leaves torch either raises in the derivative, or gives a slope of zero without a word (`float(t)`). The latter is
found by differences: where values change smoothly, the slope of torch must not be zero all around. At a single point it may
be, as at the start of t^3 or of a cycloid.
Checked in tests/math/test_torch_law.py, tests/multibody/joints/test_laws.py, tests/extensions/native/test_user_laws.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, Path, user_line
from torchmbd.math.forward_mode import jvp
from torchmbd.math.gradients import refuse_lost_gradients

# What a law may raise where it ends, as a table does, at states and times that a motion need not come to.
OUT_OF_RANGE = (ValueError, IndexError, ArithmeticError, AssertionError)
PLACES = (0.0, 0.0021, 0.013, 0.047, 0.11, 0.27, 0.57, 1.3, 4.1)  # of the argument, where slopes are compared
STEP = 1e-4
AROUND = (0.0, -1.0, -0.4, 0.7, 1.0)  # steps from a place: not symmetric, so that zeros of an odd slope do not coincide
#: Of a difference over two steps: the change from one step to the other beyond which the law bends or jumps.
SMOOTH = 0.1


def require_differentiable(
    what: Path, law: Callable[[Tensor], Any], allowed: str, signed: bool = False, known: Iterable[Tensor] = ()
) -> None:
    """InputError for a law of one number [] that torch does not differentiate, or that reads other tensors with a gradient.

    what     the keys to the law, as ("spring", "law")
    allowed  what a law may be
    signed   the argument is a coordinate or a rate, which may be negative, and not a time
    known    parameters of the law that are design variables
    """
    known = list(known)
    _slope(what, law, 0.0, allowed)
    for place in (*PLACES, *(-x for x in PLACES[1:] if signed)):
        try:
            with torch.inference_mode(False), torch.enable_grad():
                forces = [law(_number(place + k * STEP)) for k in (-1, 0, 1)]
            before, here, after = (float(x.detach() if isinstance(x, Tensor) else x) for x in forces)
        except OUT_OF_RANGE:
            continue
        except Exception as error:  # a law may do anything
            raise InputError(
                what, law, allowed, state=f"raises {error!r} in {user_line(error)} near {place:.6g}"
            ) from error
        for x in forces:
            refuse_lost_gradients(what, x, allowed, known)
        change = after - before
        smooth = change != 0.0 and abs(after - 2.0 * here + before) <= SMOOTH * abs(change)
        if smooth and all(_slope(what, law, place + k * STEP, allowed) == 0.0 for k in AROUND):
            state = "changes, but its derivative in torch is zero, because it leaves torch (float, .item(), .detach(), NumPy)"
            raise InputError(what, law, allowed, state=state)


def _number(x: float) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def _slope(what: Path, law: Callable[[Tensor], Any], place: float, allowed: str) -> float:
    at = _number(place)
    try:
        return float(jvp(law, (at,), (torch.ones_like(at),))[1].detach())
    except InputError:
        raise
    except Exception as error:  # a law may do anything
        text = str(error).partition("\n")[0] or repr(error)
        raise InputError(what, law, allowed, state=f"cannot be differentiated by torch ({text})") from error
