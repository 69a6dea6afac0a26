"""Compiled steps: ahead-of-time packages of the operations in step.py, cached on disk, one set per topology.

    CompiledModel.of(dynamics, x, w)    None while no package is ready: the eager model serves, with the same results
    build_in_background(dynamics)       compiles in a process of its own

A package is valid for one key: topology (bodies, vectors, primitives, modes), the shapes of the data and which of them
carry tangents, the number of design variables, the versions of torch and Python, the kind of processor, and the source of
everything that the operations are made of. So a stale package is never found. Step size and spectral radius are inputs,
lanes are dynamic (two at least: one lane runs twice). Laws of drives stay outside: any torch function.
Packages assume the strides they were exported with, silently: every input is made contiguous.
A package that cannot be loaded is removed with a message; without a C++ compiler the eager step serves, said once.

Cache: TORCHMBD_CACHE or ~/.cache/torchmbd. TORCHMBD_COMPILE=0 switches compilation off.
Checked in tests/integrators/test_compiled.py.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.forces.laws import LAWS
from torchmbd.integrators.step import Model, State, Weights
from torchmbd.numerics.pair import Pair, separate
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.saddle import Saddle
from torchmbd.system.topology import Prescribed, Topology

_SOURCES = ("numerics", "joints/primitive.py", "forces", "system", "integrators/step.py", "integrators/compiled.py")
_READY = "ready"
# Which batch starts a build: an optimization evaluates gradients again and again, values alone now and then. With one or
# two cores a build slows the simulations beside it by half, so that a study of two minutes is better off without it.
_GRADIENTS, _VALUES_ALONE = 2, 8
_FEW_CORES, _PATIENCE = 2, 60.0  # [s] after the first batch
_loaded: dict[str, Any] = {}
_seen: dict[str, tuple[int, float]] = {}  # batches without packages, and when the first was
_building: dict[str, subprocess.Popen] = {}


def cache_folder() -> Path:
    """Where packages are kept."""
    return Path(os.environ.get("TORCHMBD_CACHE") or Path.home() / ".cache" / "torchmbd")


def entries() -> list[tuple[Path, int, bool]]:
    """What lies in the cache: path, bytes, and whether it is a complete set of packages."""
    if not cache_folder().is_dir():
        return []
    found = []
    for path in sorted(cache_folder().iterdir()):
        files = [f for f in path.rglob("*") if f.is_file()] if path.is_dir() else [path]
        found.append((path, sum(f.stat().st_size for f in files), (path / _READY).exists()))
    return found


def enabled() -> bool:
    """Whether compilation is wanted and a C++ compiler is there."""
    if os.environ.get("TORCHMBD_COMPILE") == "0":
        return False
    if shutil.which(os.environ.get("CXX", "g++")) is None:
        warnings.warn("no C++ compiler: simulations run uncompiled, about ten times slower in batches", stacklevel=2)
        os.environ["TORCHMBD_COMPILE"] = "0"
        return False
    return True


@dataclass(frozen=True)
class Signature:
    """What the operations depend on besides the topology."""

    names: tuple[str, ...]  # of the data
    shapes: tuple[tuple[int, ...], ...]  # components of each
    pairs: tuple[bool, ...]
    tangents: int

    @classmethod
    def of(cls, dynamics: Dynamics) -> Signature:
        names = tuple(sorted(dynamics.data))
        data = [dynamics.data[name] for name in names]
        shapes = tuple(tuple(x.shape[:-2]) for x in data)
        return cls(names, shapes, tuple(isinstance(x, Pair) for x in data), dynamics.tangents)

    def unpack(self, arrays: list[Tensor]) -> dict[str, Any]:
        """Data by name."""
        return {n: _pair(x) if p else x for n, x, p in zip(self.names, arrays, self.pairs, strict=True)}

    def state(self, arrays: list[Tensor]) -> State:
        """A state of arrays."""
        return State(*(_pair(x) if self.tangents else x for x in arrays))


def _pair(full: Tensor) -> Pair:
    return Pair.of(full[..., :1, :], full[..., 1:, :]) if torch.compiler.is_exporting() else Pair(full)


def bare(T: Topology) -> Topology:
    """The topology without bodies and laws: what the operations see."""
    attached = tuple(replace(a, body=None) for a in T.attached)
    primitives = tuple(type(p)(p.members, () if p.driven else p.data) for p in T.primitives)
    carriers = tuple(replace(c, law=None) for c in T.carriers)
    return replace(T, attached=attached, primitives=primitives, carriers=carriers)


def key(T: Topology, signature: Signature) -> str:
    """Name of the packages of a topology and signature, for this source, these versions and this processor."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for source in _SOURCES:
        path = package / source
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    attached = [(a.mount is None, a.is_point) for a in T.attached]
    members = [(type(p).__name__, [m.tolist() for m in p.members], () if p.driven else p.data) for p in T.primitives]
    actions = [(type(a).__name__, [m.tolist() for m in a.members], repr(a.laws)) for a in T.actions]
    folds = [f.table.tolist() for f in (T.vector_fold, T.body_fold, T.modal_fold)]
    vectors = [x.tolist() for x in (T.vector_body, T.vector_origin, T.vector_flexible)]
    rates = None if T.rates is None else T.rates.tolist()
    facts = [
        len(T.names),
        len(T.carriers),
        T.flexible,
        T.modes,
        attached,
        members,
        actions,
        folds,
        vectors,
        rates,
        signature,
    ]
    versions = [torch.__version__, sys.version_info[:2], platform.machine(), torch.backends.cpu.get_cpu_capability()]
    digest.update(repr([facts, versions]).encode())
    return digest.hexdigest()[:32]


def _known_laws(T: Topology) -> bool:
    """Whether all laws of forces are numbers of a known form: the code of a user's own is not in the key."""
    laws = [law for action in T.actions for law in action.laws]
    return all(type(law) in LAWS and not callable(getattr(law, "law", None)) for law in laws)


def _wanted(name: str, dynamics: Dynamics) -> None:
    """Take note of a batch without packages; start to build them when it will pay."""
    count, since = _seen.get(name, (0, time.monotonic()))
    _seen[name] = (count + 1, since)
    often = count + 1 >= (_GRADIENTS if dynamics.tangents else _VALUES_ALONE)
    patient = time.monotonic() - since >= (_PATIENCE if len(os.sched_getaffinity(0)) <= _FEW_CORES else 0.0)
    if often and patient and name not in _building:
        build_in_background(dynamics)


class _Operation(nn.Module):
    """One operation of a step on flat lists of tensors."""

    def __init__(self, T: Topology, saddle: Saddle, signature: Signature):
        super().__init__()
        self.T, self.saddle, self.signature = T, saddle, signature

    def forward(
        self, weights: Tensor, state: list[Tensor], data: list[Tensor], given: list[Tensor], rest: list[Tensor]
    ) -> tuple[Tensor, ...]:
        A, r, t, *laws = given
        parts = iter(laws)
        known = [tuple(islice(parts, p.driven)) if p.driven else None for p in self.T.primitives]
        model = Model(self.T, self.saddle, Weights(*weights.unbind(0)), self.signature.unpack(data))
        return self.run(model.step(self.signature.state(state), Prescribed(known, A, r, t)), *rest)

    def run(self, step: Any, *rest: Tensor) -> tuple[Tensor, ...]:
        raise NotImplementedError


class _Correct(_Operation):
    def run(self, step, *rest):
        return step.correct(*rest)


class _Matrix(_Operation):
    def run(self, step, *rest):
        return (step.matrix(*rest),)


class _Tangent(_Operation):
    def run(self, step, *rest):
        return step.tangent(*rest)


class _Finish(_Operation):
    def run(self, step, *rest):
        return tuple(y.full if isinstance(y, Pair) else y for y in step.finish(*rest))


_VALUES: dict[str, type[_Operation]] = {"correct": _Correct, "matrix": _Matrix, "finish": _Finish}


def operations(signature: Signature) -> dict[str, type[_Operation]]:
    """The operations that a signature needs."""
    return _VALUES | ({"tangent": _Tangent} if signature.tangents else {})


class CompiledModel:
    """What all steps of a simulation share: packages in place of the operations of step.py, and the data, flat."""

    def __init__(self, dynamics: Dynamics, packages: dict[str, Any], lanes: int, w: Weights):
        self.packages = packages
        self.signature = Signature.of(dynamics)
        self.twice = lanes == 1  # packages take two lanes at least
        self.weights = torch.tensor(w, dtype=torch.float64)
        self.data = flat_data(dynamics, self.signature, max(lanes, 2))

    @staticmethod
    def of(dynamics: Dynamics, x: State, w: Weights) -> CompiledModel | None:
        """The compiled model of a topology if its packages are ready; asked for again, they are built in the background."""
        if not enabled() or not _known_laws(dynamics.topology):
            return None
        name = key(dynamics.topology, Signature.of(dynamics))
        if name not in _loaded:
            folder = cache_folder() / name
            if not (folder / _READY).exists():
                _wanted(name, dynamics)
                return None
            packages = _load(folder, Signature.of(dynamics))
            if packages is None:
                return None
            _loaded[name] = packages
        return CompiledModel(dynamics, _loaded[name], x.q.shape[-1], w)

    def step(self, x: State, given: Prescribed) -> CompiledStep:
        """The step from x."""
        return CompiledStep(self, x, given)


class CompiledStep:
    """A step (see step.py) made of packages."""

    def __init__(self, model: CompiledModel, x: State, given: Prescribed):
        self.model = model
        state = [self._lanes(y.full if isinstance(y, Pair) else y) for y in x]
        laws = [part.contiguous() for law in given.laws if law is not None for part in law]
        self.start = [model.weights, *state, *model.data, given.A.contiguous(), given.r.contiguous(), given.t, *laws]

    def _call(self, name: str, *rest: Tensor) -> list[Tensor]:
        # Flat inputs go past the package's own unpacking of nested lists, which costs as much as a small operation.
        return self.model.packages[name].loader.boxed_run([*self.start, *rest])

    def _lanes(self, y: Tensor, axis: int = -1) -> Tensor:
        if self.model.twice:
            y = y.expand(2, *y.shape[1:]) if axis == 0 else y.expand(*y.shape[:-1], 2)
        return y.contiguous()

    def _own(self, y: Tensor) -> Tensor:
        return y[..., :1] if self.model.twice else y

    def correct(self, H: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        z, size = self._call("correct", self._lanes(H, 0), self._lanes(z))
        return self._own(z), self._own(size)

    def matrix(self, z: Tensor) -> Tensor:
        (K,) = self._call("matrix", self._lanes(z))
        return K[:1] if self.model.twice else K

    def tangent(self, H: Tensor, z: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
        dz, size = self._call("tangent", self._lanes(H, 0), self._lanes(z), self._lanes(dz))
        return self._own(dz), self._own(size)

    def finish(self, z: Tensor, dz: Tensor | None = None) -> State:
        rest = [self._lanes(z)] if dz is None else [self._lanes(z), self._lanes(dz)]
        return self.model.signature.state([self._own(y) for y in self._call("finish", *rest)])


def flat_data(dynamics: Dynamics, signature: Signature, lanes: int) -> list[Tensor]:
    """The data in the order of the signature, contiguous, every one with all lanes."""
    arrays = [dynamics.data[name] for name in signature.names]
    full = [x.full if isinstance(x, Pair) else x for x in arrays]
    return [x.expand(*x.shape[:-1], lanes).contiguous() for x in full]


def _load(folder: Path, signature: Signature) -> dict[str, Any] | None:
    from torch._inductor import aoti_load_package

    try:
        return {name: aoti_load_package(str(folder / f"{name}.pt2")) for name in operations(signature)}
    except (RuntimeError, OSError, zipfile.BadZipFile, ValueError) as error:
        warnings.warn(f"compiled package {folder} cannot be loaded and is removed: {error}", stacklevel=3)
        shutil.rmtree(folder, ignore_errors=True)
        return None


def build_in_background(dynamics: Dynamics) -> subprocess.Popen | None:
    """Compile the packages of a topology in a process of its own, at low priority; returns it, or None if it runs."""
    signature = Signature.of(dynamics)
    name = key(dynamics.topology, signature)
    if name in _building and _building[name].poll() is None:
        return None
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        handle, path = tempfile.mkstemp(suffix=".job", dir=cache_folder())
        with os.fdopen(handle, "wb") as file:
            pickle.dump((bare(dynamics.topology), signature, name), file)
    except OSError as error:
        warnings.warn(f"nothing can be compiled: {error}; simulations run uncompiled", stacklevel=2)
        return None
    command = [sys.executable, "-m", "torchmbd.integrators.compiled", path]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    with open(os.devnull, "wb") as nothing:
        _building[name] = subprocess.Popen(
            command, env=environment, stdout=nothing, stderr=nothing, start_new_session=True
        )
    return _building[name]


def build(T: Topology, signature: Signature, name: str) -> Path:
    """Export and compile all operations; the folder appears complete or not at all."""
    folder = cache_folder() / name
    with tempfile.TemporaryDirectory(dir=cache_folder()) as work:
        target = Path(work) / "packages"
        target.mkdir()
        saddle = Saddle(T)
        for operation, kind in operations(signature).items():
            _package(kind(T, saddle, signature), operation, T, signature, target / f"{operation}.pt2")
        (target / _READY).touch()
        with contextlib.suppress(FileExistsError):  # another process built the same meanwhile
            os.rename(target, folder)
    return folder


def _package(module: _Operation, name: str, T: Topology, signature: Signature, path: Path) -> None:
    import torch._inductor

    lanes, n, slots = 4, T.n_v + T.rows, 1 + signature.tangents

    def numbers(*shape: int) -> Tensor:
        return torch.rand(*shape, lanes, dtype=torch.float64)

    state = [numbers(k, slots) for k in (T.n_q, T.n_v, T.n_v, T.n_v, T.rows)]
    data = [numbers(*s, slots if p else 1) for s, p in zip(signature.shapes, signature.pairs, strict=True)]
    carriers = 1 + len(T.carriers)
    given = [torch.rand(*shape, carriers, 1, 1, dtype=torch.float64) for shape in ((3, 3), (3,))]
    given.append(torch.rand((), dtype=torch.float64))
    given += [torch.ones(len(p.members[0]), 1, 1, dtype=torch.float64) for p in T.primitives for _ in range(p.driven)]
    z, dz = numbers(n, 1), [numbers(n, signature.tangents)] if signature.tangents else []
    H = torch.rand(lanes, n, n, dtype=torch.float64)
    rest = {"correct": [H, z], "matrix": [z], "finish": [z, *dz], "tangent": [H, z, *dz]}[name]
    batch = torch.export.Dim("lanes", min=2, max=65536)
    dims = (
        None,
        [{2: batch}] * 5,
        [{x.dim() - 1: batch} for x in data],
        [None] * len(given),
        [{0: batch} if x is H else {2: batch} for x in rest],
    )
    weights = torch.rand(len(Weights._fields), dtype=torch.float64)
    with torch.no_grad(), separate():
        program = torch.export.export(module, (weights, state, data, given, rest), dynamic_shapes=dims, strict=False)
        torch._inductor.aoti_compile_and_package(program, package_path=str(path))


def main(path: str) -> None:
    """Run a job file of `build_in_background`."""
    os.nice(10)
    torch.set_num_threads(1)
    job = Path(path)
    T, signature, name = pickle.loads(job.read_bytes())
    job.unlink()
    build(T, signature, name)


if __name__ == "__main__":
    main(sys.argv[1])
