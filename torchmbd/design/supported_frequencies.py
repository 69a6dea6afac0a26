"""Natural frequencies of a body on supports of its own for measures: cases of mbd.natural_frequencies, made once for each body.

Checked in tests/design/test_frequencies.py.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

from torch import Tensor, nn

from torchmbd.design.histories import flexible_body
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.digest import digest
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.statics import VibrationCase
from torchmbd.multibody.statics.supported_body import Supports
from torchmbd.multibody.system import System

_CASES: WeakKeyDictionary[nn.Module, dict[str, VibrationCase]] = WeakKeyDictionary()  # body -> digest of supports


def supported_frequencies(motion: Trajectory, body: str, supports: Supports, number: int) -> Tensor:
    """The lowest frequencies [lanes, number] [Hz] of a body on supports, in the designs of a motion."""
    case = _case(motion.system, body, supports)
    return motion.of_designs(lambda: case(number).frequencies).expand(motion.lanes, number)


def check_supports(system: System, body: str, supports: Supports, number: int) -> None:
    """InputError for supports that a body cannot have, or a number of frequencies beyond its degrees of freedom."""
    most = _case(system, body, supports).most
    if number > most:
        raise InputError("number", number, f"1 to {most}, the degrees of freedom that {body!r} has on its supports")


def _case(system: System, name: str, supports: Supports) -> VibrationCase:
    body = flexible_body(system, name)
    cases, key = _CASES.setdefault(body, {}), digest(supports)
    if key not in cases:
        cases[key] = outside_transforms(lambda: VibrationCase(body, supports))
    return cases[key]
