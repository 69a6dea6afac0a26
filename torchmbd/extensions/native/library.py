"""Compiled code on disk: one shared library per kind of mechanism and function, built by the C++ compiler of the machine.

    kind       of mechanisms: kinds of joints and forces, not how many, nor of what sizes (symbolic.py)
    function   "step", "adjoint", "rates" or "start" (functions.py)

A library is valid for one key: the kind, the function, the source of everything that the code is made of, and what every
library depends on (codegen/compiler.py). Counts, tables, step size, lanes and design variables are inputs.
Laws of drives stay outside: any torch function. Laws of forces of users are traced as scalar operations
(user_laws.py), which are in the key; where that cannot be done the system stays uncompiled.
A library that is missing is built before the first step (`obstacle`), once for a machine: the same call gives the same numbers
every time.
Checked in tests/extensions/native/test_library.py.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from torch import Tensor

from torchmbd.errors import MbdError, warn
from torchmbd.extensions.native import data, functions, simd_layout
from torchmbd.extensions.native.codegen import build_cache
from torchmbd.extensions.native.codegen.compiler import (
    SUFFIX,
    compiler,
    load,
    options,
    toolchain_digest,
    unavailable,
)
from torchmbd.extensions.native.codegen.scalars import Untraceable
from torchmbd.extensions.native.feedback import CalledLaws, Feedback
from torchmbd.extensions.native.mechanism import Mechanism
from torchmbd.extensions.native.user_laws import native_law
from torchmbd.math.digest import digest
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.process import cache_folder, require_cache_folder, thread_count
from torchmbd.progress import stage

_SOURCES = (
    "math",
    "multibody/joints/primitive.py",
    "multibody/forces",
    "multibody/equations",
    "multibody/saddle",
    "multibody/system/dynamics.py",
    "integrate/step.py",
    "integrate/smooth_start.py",
    "extensions/native",
    "extensions/native/codegen",
    *(f"extensions/native/{name}.cpp" for name in ("factors", "feedback", "steps", "adjoint", "rates", "start")),
)
_MECHANISM, _COUNT = ctypes.c_void_p, ctypes.c_long
_BLOCKS: list[Any] = [
    ctypes.c_void_p,
    _COUNT,
    _COUNT,
    ctypes.c_void_p,
]  # a `Job`, the first block and the end, scratch memory
#: Functions of all libraries that Python calls: arguments, where these are not one `Job`, and the type of the result.
_PROTOTYPES: dict[str, tuple[list[Any] | None, Any]] = {
    "needed": (None, ctypes.c_char_p),
    "run_steps": (_BLOCKS, _COUNT),
    "steps_scratch": ([_MECHANISM, _COUNT], _COUNT),
    "steps_factors": ([_MECHANISM], _COUNT),
    "adjoint": (_BLOCKS, _COUNT),
    "adjoint_scratch": ([_MECHANISM, _COUNT, _COUNT], _COUNT),
    "rates": (None, _COUNT),
    "rates_scratch": ([_MECHANISM], _COUNT),
    "start": (_BLOCKS, _COUNT),
    "start_scratch": ([_MECHANISM, _COUNT], _COUNT),
}
_loaded: dict[str, ctypes.CDLL] = {}
_failed: dict[str, str] = {}  # builds that failed, and why
_warned: set[str] = set()


def obstacle(dynamics: Dynamics, work: Sequence[str]) -> str | None:
    """The reason why there is no native code for a system, None if there is; libraries for this work are built.

    The first kind of work is needed; a library of another that cannot be built is not an obstacle. Steps and their adjoint are
    those of the condensed system.
    """
    if (why := unavailable()) is not None:
        return why
    try:
        known = with_traced_laws(dynamics)
    except Untraceable as error:
        return f"a law of a force cannot be compiled: {error}"
    if not work:
        return None
    steps = with_traced_laws(dynamics.condensed()) if "step" in work else known
    parts = [(steps, kind) for kind in work]
    if "step" in work and has_start(known):
        parts.append((known, "start"))
    return _failed.get(_load(parts)[0])


def has_start(dynamics: Dynamics) -> bool:
    """True if compiled code makes the start of a motion (start.py).

    There must be joints; drives with design variables and laws that are called back are left to operators of torch.
    """
    T = dynamics.topology
    return bool(T.rows) and not (T.varying_primitives or calls_back(dynamics))


@dataclass(frozen=True)
class Library:
    """Native code for one system. mechanism: its counts and tables, a struct of the code."""

    code: ctypes.CDLL
    mechanism: Any

    @property
    def address(self) -> int:
        """Address of the mechanism."""
        return ctypes.addressof(self.mechanism)

    @property
    def called(self) -> CalledLaws:
        """Laws that the code calls back."""
        return self.mechanism.kept[0].called

    def threads(self, lanes: int) -> int:
        """The number of threads that make steps: one where laws are called back."""
        return 1 if self.called.actions else threads_of(lanes)

    def feedback(self, dynamics: Dynamics) -> Feedback | None:
        """Serves these calls; None: there are no such laws."""
        laws = self.called
        return Feedback(laws, dynamics.data, dynamics.lanes, dynamics.tangents) if laws.actions else None

    def data_blocks(self, dynamics: Dynamics) -> tuple[Tensor, Tensor]:
        """Data in the layout of the code: values [block, 1, n, LANES] and tangents [block, n_b, n, LANES]."""
        return self.value_blocks(dynamics), simd_layout.blocks(data.flat_tangents(with_traced_laws(dynamics)))

    @staticmethod
    def value_blocks(dynamics: Dynamics) -> Tensor:
        """The values alone, which are kept with the dynamics: steps at switches and the adjoint take them again."""
        if dynamics not in _value_blocks:
            _value_blocks[dynamics] = simd_layout.blocks(data.flat_values(with_traced_laws(dynamics))).detach()
        return _value_blocks[dynamics]

    def unflattened(self, dynamics: Dynamics, by: Tensor) -> dict[str, Tensor]:
        """Cotangents of the data [component..., rows, lanes] out of those of the numbers of the code."""
        return data.unflattened(with_traced_laws(dynamics), by)


def library(dynamics: Dynamics, kind: str = "step") -> Library | None:
    """The library of a system, built if it is missing; None: operators of torch serve, with one warning."""
    known = with_traced_laws(dynamics)
    [name] = _load([(known, kind)])
    if name in _failed and name not in _warned:
        _warned.add(name)
        warn(
            f"there is no native code of the {kind}, so simulations use the slower operators of torch: {_failed[name]}"
        )
    code = _loaded.get(name)
    return None if code is None else Library(code, _mechanism(dynamics.topology, known, kind, name, code))


_mechanisms: WeakKeyDictionary[Topology, dict[str, Any]] = WeakKeyDictionary()
_keys: WeakKeyDictionary[Topology, dict[tuple, str]] = WeakKeyDictionary()
_value_blocks: WeakKeyDictionary[Dynamics, Tensor] = WeakKeyDictionary()


def _mechanism(T: Topology, known: Dynamics, kind: str, name: str, code: ctypes.CDLL) -> Any:
    """Counts and tables of a system, made once for its topology."""
    mechanisms = _mechanisms.setdefault(T, {})
    if name not in mechanisms:
        mechanisms[name] = Mechanism(known.topology, known.saddle.blocks.rows, kind in ("step", "adjoint")).struct(code)
    return mechanisms[name]


def _load(parts: Sequence[tuple[Dynamics, str]]) -> list[str]:
    """Load libraries of a system, or of its condensed one; those that are missing are built first, in parallel: their names."""
    missing: dict[str, tuple[Dynamics, str]] = {}
    names = [key(dynamics, kind) for dynamics, kind in parts]
    for (dynamics, kind), name in zip(parts, names, strict=True):
        if name in _loaded or name in _failed:
            continue
        code = _loaded_library(_path(name, kind))
        if code is None:
            missing[name] = dynamics, kind
        else:
            _loaded[name] = code
    if not missing:
        return names
    system = ", ".join(parts[0][0].topology.names)
    with stage("compiling"), ThreadPoolExecutor(len(missing)) as pool:
        # tracing is of one thread
        texts = [functions.source(data.kind_of(dynamics), kind) for dynamics, kind in missing.values()]
        for name, path, why in pool.map(_built, missing, (kind for _, kind in missing.values()), texts, repeat(system)):
            code = _loaded_library(path) if why is None else None
            if code is None:
                _failed[name] = why or f"{path} cannot be loaded"
            else:
                _loaded[name] = code
    return names


def _loaded_library(path: Path) -> ctypes.CDLL | None:
    """The library of a file, its functions with their types; None if there is none."""
    code = load(path)
    for name, (arguments, result) in _PROTOTYPES.items() if code is not None else ():
        if hasattr(code, name):
            function = getattr(code, name)
            function.argtypes, function.restype = arguments, result
    return code


def _built(name: str, kind: str, text: str, system: str) -> tuple[str, Path, str | None]:
    """Name and path of a library that is compiled, and the reason of a failure or None."""
    try:
        return name, build(name, kind, text, system), None
    except (MbdError, OSError) as error:
        return name, _path(name, kind), str(error)


def calls_back(dynamics: Dynamics) -> bool:
    """True if native code calls laws of a system back."""
    return any(isinstance(law, Port) for action in with_traced_laws(dynamics).topology.actions for law in action.laws)


def threads_of(lanes: int) -> int:
    """The number of threads that share the blocks of so many lanes."""
    return min(thread_count(), -(-lanes // simd_layout.LANES))


def path_of(dynamics: Dynamics, kind: str = "step") -> Path:
    """Where the library of a system is, or would be."""
    return _path(key(dynamics, kind), kind)


def _path(name: str, kind: str) -> Path:
    return cache_folder() / f"{kind}-{name}{SUFFIX}"


def with_traced_laws(dynamics: Dynamics) -> Dynamics:
    """The same dynamics with laws of forces of a known form; raises Untraceable where there is one that cannot be."""
    old = dynamics.topology.actions
    new = tuple(replace(action, laws=tuple(native_law(law) for law in action.laws)) for action in old)
    if all(x.laws == y.laws for x, y in zip(new, old, strict=True)):
        return dynamics
    return replace(dynamics, topology=replace(dynamics.topology, actions=new))


def key(dynamics: Dynamics, kind: str = "step") -> str:
    """Name of the library of a system, for this source, these versions and this processor."""
    known, of = _keys.setdefault(dynamics.topology, {}), (kind, simd_layout.LANES, toolchain_digest(_SOURCES))
    names = frozenset(dynamics.data)
    if (*of, names) not in known:
        known[*of, names] = digest(*of, data.kind_of(dynamics))
    return known[*of, names]


def build(name: str, kind: str, text: str, system: str) -> Path:
    """Compile code of a system, by the names of its bodies; the library appears complete or not at all."""
    with tempfile.TemporaryDirectory(prefix=build_cache.WORK, dir=require_cache_folder()) as work:
        code, made = Path(work) / "code.cpp", Path(work) / "code.so"
        code.write_text(text)
        level = "-O1" if kind == "start" else "-O2"  # it runs once a motion: the compiler's time counts more
        done = subprocess.run(
            [compiler(), *options(level), f"-DLANES={simd_layout.LANES}", "-o", str(made), str(code)],
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise MbdError(f"{compiler()} failed on the {kind} of {system}: {done.stderr[-2000:]}")
        return build_cache.seal_and_store(made, _path(name, kind))
