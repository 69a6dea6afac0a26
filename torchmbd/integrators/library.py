"""Compiled code on disk: one shared library per topology and kind (code.py), built by the C++ compiler of the machine.

A library is valid for one key: topology (bodies, vectors, primitives, modes), the shapes of the data, the source of
everything that the code is made of, and what every library depends on (numerics/native.py). Step size, spectral radius,
lanes and design variables are inputs. Laws of drives stay outside: any torch function; laws of forces that are a user's
own are written out as scalar operations (forces/written.py), which are in the key; where that cannot be done the system
stays uncompiled.
Checked in tests/integrators/test_library.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import pickle
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchmbd.errors import MbdError
from torchmbd.forces.written import writable
from torchmbd.integrators.code import source
from torchmbd.integrators.layout import Layout
from torchmbd.numerics import build_cache
from torchmbd.numerics.native import OPTIONS, PACKAGE, SUFFIX, compiler, enabled, load, surroundings
from torchmbd.numerics.scalars import Untraceable
from torchmbd.process import cache_folder, require_cache_folder
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.topology import Topology

_SOURCES = (
    "numerics",
    "joints/primitive.py",
    "forces",
    "system",
    "integrators/step.py",
    "integrators/code.py",
    "integrators/layout.py",
)
_DRIVERS = ("factors.cpp", "march.cpp", "adjoint.cpp", "rates.cpp")
_SOURCES += tuple(f"integrators/{name}" for name in _DRIVERS)
_ASIDE = ("names", "row_names", "own_modes", "attached", "carriers")  # of a topology: what the code does not depend on
_BATCHES = 2  # the batch that starts a build: a single simulation is over before
# No module of the current folder is imported: -P, and torchmbd's own folder comes last.
_BOOT = "import sys; sys.path.append(sys.argv[1]); from torchmbd.integrators.library import main; main(sys.argv[2])"
_loaded: dict[str, Any] = {}
_seen: dict[str, int] = {}  # batches without a library
_told: set[str] = set()  # why laws cannot be compiled
_building: dict[str, subprocess.Popen | None] = {}  # None: a build that failed, which was said


def library(dynamics: Dynamics, kind: str = "step") -> ctypes.CDLL | None:
    """The library of a system if it is there; asked for again, it is built in the background."""
    if not enabled() or (known := written_out(dynamics)) is None:
        return None
    return found(known, kind, load)


def found(dynamics: Dynamics, kind: str, load: Callable[[Path], Any], place: str = "") -> Any:
    """What was built for a system, loaded for a place, if it is there; asked for again, it is built in the background."""
    name = key(dynamics, kind)
    if name + place not in _loaded:
        code = load(_path(name, kind))
        if code is None:
            _warn_of_failure(name, kind)
            _seen[name] = _seen.get(name, 0) + 1
            if _seen[name] >= _BATCHES and name not in _building:
                build_in_background(dynamics, kind)
            return None
        _loaded[name + place] = code
    return _loaded[name + place]


def at_hand(dynamics: Dynamics, kind: str = "step") -> bool:
    """Whether there is a library of a system; asking does not build one."""
    if not enabled() or (known := written_out(dynamics)) is None:
        return False
    name = key(known, kind)
    return name in _loaded or _path(name, kind).exists()


def _warn_of_failure(name: str, kind: str) -> None:
    """Say once that a build in the background has failed."""
    process = _building.get(name)
    if process is not None and process.poll():
        _building[name] = None
        log = process.args[-1]  # pyright: ignore[reportArgumentType, reportIndexIssue]
        warnings.warn(
            f"the build of compiled code failed ({kind}): simulations go on without it; see {log}", stacklevel=4
        )


def path_of(dynamics: Dynamics, kind: str = "step") -> Path:
    """Where the library of a system is, or would be."""
    return _path(key(dynamics, kind), kind)


def _path(name: str, kind: str) -> Path:
    return cache_folder() / f"{kind}-{name}{SUFFIX}"


def written_out(dynamics: Dynamics) -> Dynamics | None:
    """The same dynamics with laws of forces of a known form; None if there is one that cannot be, which is said once."""
    old = dynamics.topology.actions
    try:
        new = tuple(replace(action, laws=tuple(writable(law) for law in action.laws)) for action in old)
    except Untraceable as error:
        if str(error) not in _told:
            _told.add(str(error))
            warnings.warn(f"a law of a force cannot be compiled, simulations run uncompiled: {error}", stacklevel=2)
        return None
    if all(one.laws == other.laws for one, other in zip(new, old, strict=True)):
        return dynamics
    return replace(dynamics, topology=replace(dynamics.topology, actions=new))


def key(dynamics: Dynamics, kind: str = "step") -> str:
    """Name of the library of a system, for this source, these versions and this processor."""
    T = dynamics.topology
    attached = [(a.mount is None, a.is_point) for a in T.attached]
    facts = [
        len(T.names),
        len(T.carriers),
        attached,
        _facts({k: v for k, v in vars(bare(T)).items() if k not in _ASIDE}),
    ]
    digest = hashlib.sha256(repr([kind, facts, Layout.of(dynamics.data, T)]).encode())
    digest.update(surroundings(_SOURCES).encode())
    return digest.hexdigest()[:32]


def _facts(x: Any) -> Any:
    """Everything that an object is made of, as numbers, names and lists."""
    if isinstance(x, torch.Tensor):
        return x.tolist()
    if isinstance(x, dict):
        return [(k, _facts(y)) for k, y in sorted(x.items())]
    if isinstance(x, (list, tuple)):
        return [_facts(y) for y in x]
    return (type(x).__qualname__, _facts(vars(x))) if hasattr(x, "__dict__") else repr(x)


def bare(T: Topology) -> Topology:
    """The topology without bodies and laws: what the operations see."""
    attached = tuple(replace(a, body=None) for a in T.attached)
    primitives = tuple(type(p)(p.members, () if p.driven else p.data) for p in T.primitives)
    carriers = tuple(replace(c, law=None) for c in T.carriers)
    return replace(T, attached=attached, primitives=primitives, carriers=carriers)


Order = tuple[Topology, Layout, str, Any, str]


def order(dynamics: Dynamics, kind: str = "step") -> Order:
    """What `build` needs; can be pickled."""
    T, zero = dynamics.topology, torch.zeros((), dtype=torch.float64)
    sample = T.prescribed(zero).shared(T.varied) if kind != "rates" else T.law_jets(zero)
    return bare(T), Layout.of(dynamics.data, T), kind, sample, key(dynamics, kind)


def build(T: Topology, layout: Layout, kind: str, sample: Any, name: str) -> Path:
    """Write and compile the code of a topology; the library appears complete or not at all."""
    with tempfile.TemporaryDirectory(prefix=build_cache.WORK, dir=require_cache_folder()) as work:
        text, made = Path(work) / "code.cpp", Path(work) / "code.so"
        text.write_text(source(T, layout, kind, sample))
        done = subprocess.run(
            [compiler(), "-O1", "-fexpensive-optimizations", *OPTIONS, "-o", str(made), str(text)],
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise MbdError(f"{compiler()} failed on the {kind} of {', '.join(T.names)}: {done.stderr[-2000:]}")
        return build_cache.keep(made, _path(name, kind))


def build_in_background(dynamics: Dynamics, kind: str = "step") -> subprocess.Popen | None:
    """Compile the code of a topology in a process of its own, at low priority; returns it, or None if it cannot begin."""
    ordered = order(dynamics, kind)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    try:
        log = _path(ordered[-1], kind).with_suffix(".log")
        require_cache_folder()
        command = [sys.executable, "-P", "-c", _BOOT, str(PACKAGE.parent), str(log)]
        with tempfile.TemporaryFile() as job, log.open("wb") as output:  # without a name: no other can write it
            pickle.dump(ordered, job)
            job.seek(0)
            process = subprocess.Popen(
                command, env=environment, stdin=job, stdout=output, stderr=output, start_new_session=True
            )
    except OSError as error:
        warnings.warn(f"nothing can be compiled: {error}; simulations run uncompiled", stacklevel=2)
        return None
    _building[ordered[-1]] = process
    return process


def main(log: str) -> None:
    """Build what `build_in_background` has written to the standard input; a log stays only where that fails."""
    os.nice(10)
    torch.set_num_threads(1)
    build(*pickle.load(sys.stdin.buffer))
    Path(log).unlink(missing_ok=True)  # another process may build the same
