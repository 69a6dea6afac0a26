"""Optimization of flexible multibody systems made of composite materials, with exact gradients.

system = mbd.System(bodies, joints)      structure and topology
motion = mbd.simulate(system, ...)       transient motion, with sensitivities
problem = mbd.Problem(system, ...)       what to minimize, subject to what
result = mbd.optimize(problem)           exact gradients inside
study = mbd.load(run, model="arm.py")    a tracked study as objects again

The names are those of torchmbd.api, which is imported at the first access to one of them: it imports torch, which takes
seconds, and `torchmbd --help` and `torchmbd best` do not need it; and those of torchmbd/extensions, if it is there.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from torchmbd.registry import public, public_names, rooms

if TYPE_CHECKING:
    from torchmbd.api import *  # noqa: F403
    from torchmbd.extensions import *  # noqa: F403

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    api = importlib.import_module("torchmbd.api")
    if name == "__all__":
        return [*api.__all__, *rooms(), *(x for x in public_names() if "." not in x)]
    return getattr(api, name) if name in api.__all__ else public(name)


def __dir__() -> list[str]:
    return [*(name for name in globals() if name.startswith("__")), *__getattr__("__all__")]
