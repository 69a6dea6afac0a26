"""Compiled code for tests: built when somebody asks for it (the fixture `built` of conftest.py)."""

from __future__ import annotations

from torchmbd.integrators import library
from torchmbd.system import Dynamics


class BuiltAtOnce:
    """In the place of `library`: builds what is asked for, and waits. used: what it gave;  kinds: of which kind."""

    def __init__(self) -> None:
        self.used: list[object] = []
        self.kinds: list[str] = []

    def __call__(self, dynamics: Dynamics, kind: str = "step") -> object:
        known = library.written_out(dynamics)
        assert known is not None
        if not library.path_of(known, kind).exists():
            library.build(*library.order(known, kind))
        self.kinds.append(kind)
        self.used.append(library.library(dynamics, kind))
        return self.used[-1]
