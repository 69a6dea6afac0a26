"""Compiled steps: ahead-of-time packages of the operations in step.py, cached on disk, one set per topology.

    step = CompiledStep.of(dynamics)      None while no package is ready: the eager step serves, with the same results
    build_in_background(dynamics)         compiles in a process of its own

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
import warnings
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.integrators.step import State, Step, Weights
from torchmbd.numerics.pair import Pair
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.saddle import Saddle
from torchmbd.system.topology import Topology

_SOURCES = ("numerics", "joints/primitive.py", "system", "integrators/step.py", "integrators/compiled.py")
_READY = "ready"
_loaded: dict[str, Any] = {}
_seen: dict[str, int] = {}
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
        return {n: Pair(x) if p else x for n, x, p in zip(self.names, arrays, self.pairs, strict=True)}

    def state(self, arrays: list[Tensor]) -> State:
        """A state of arrays."""
        return State(*(Pair(x) if self.tangents else x for x in arrays))


def bare(T: Topology) -> Topology:
    """The topology without bodies and laws: what the operations see."""
    attached = tuple(replace(a, body=None) for a in T.attached)
    primitives = tuple(type(p)(p.members, () if p.driven else p.data) for p in T.primitives)
    return replace(T, attached=attached, primitives=primitives)


def key(T: Topology, signature: Signature) -> str:
    """Name of the packages of a topology and signature, for this source, these versions and this processor."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for source in _SOURCES:
        path = package / source
        for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    attached = [(a.node is None, a.is_point) for a in T.attached]
    members = [(type(p).__name__, [m.tolist() for m in p.members], () if p.driven else p.data) for p in T.primitives]
    folds = [f.table.tolist() for f in (T.vector_fold, T.body_fold, T.modal_fold)]
    vectors = [x.tolist() for x in (T.vector_body, T.vector_origin, T.vector_flexible)]
    facts = [len(T.names), T.flexible, T.modes, attached, members, folds, vectors, signature]
    versions = [torch.__version__, sys.version_info[:2], platform.machine(), torch.backends.cpu.get_cpu_capability()]
    digest.update(repr([facts, versions]).encode())
    return digest.hexdigest()[:32]


class _Operation(nn.Module):
    """One operation of a step on flat lists of tensors."""

    def __init__(self, step: Step, signature: Signature):
        super().__init__()
        self.step, self.signature = step, signature

    def forward(
        self, weights: Tensor, state: list[Tensor], data: list[Tensor], drives: list[Tensor], rest: list[Tensor]
    ) -> tuple[Tensor, ...]:
        w = Weights(*weights.unbind(0))
        pairs = iter(drives)
        law = [(next(pairs), next(pairs)) if p.driven else None for p in self.step.T.primitives]
        return self.run(w, self.signature.state(state), self.signature.unpack(data), law, *rest)

    def run(self, w: Weights, x: State, data: dict, drives: list, *rest: Tensor) -> tuple[Tensor, ...]:
        raise NotImplementedError


class _Correct(_Operation):
    def run(self, w, x, data, drives, H, z):
        return self.step.correct(w, data, x, H, z, drives)


class _Matrix(_Operation):
    def run(self, w, x, data, drives, z):
        return (self.step.matrix(w, data, x, z, drives),)


class _TangentFirst(_Operation):
    def run(self, w, x, data, drives, H, z):
        return self.step.tangent_first(w, data, x, H, z, drives)


class _TangentNext(_Operation):
    def run(self, w, x, data, drives, H, z, R, correction, dz):
        return self.step.tangent_next(w, data, x, H, z, drives, R, correction, dz)


class _Finish(_Operation):
    def run(self, w, x, data, drives, z, *dz):
        new = self.step.finish(w, x, Pair.of(z, dz[0]) if dz else z)
        return tuple(y.full if isinstance(y, Pair) else y for y in new)


_VALUES = {"correct": _Correct, "matrix": _Matrix, "finish": _Finish}
_WITH_INVERSE = ("correct", "tangent_first", "tangent_next")
_TANGENTS = {"tangent_first": _TangentFirst, "tangent_next": _TangentNext}


def operations(signature: Signature) -> dict[str, type[_Operation]]:
    """The operations that a signature needs."""
    return _VALUES | (_TANGENTS if signature.tangents else {})


class CompiledStep:
    """A step (see step.py) whose operations are packages; the data are given once."""

    def __init__(self, dynamics: Dynamics, packages: dict[str, Any], lanes: int):
        self.T, self.packages = dynamics.topology, packages
        self.signature = Signature.of(dynamics)
        self.twice = lanes == 1  # packages take two lanes at least
        self.data = flat_data(dynamics, self.signature, max(lanes, 2))

    @staticmethod
    def of(dynamics: Dynamics, lanes: int) -> CompiledStep | None:
        """The compiled step of a topology, if its packages are ready; builds them in the background at the second call."""
        if not enabled():
            return None
        name = key(dynamics.topology, Signature.of(dynamics))
        if name not in _loaded:
            folder = cache_folder() / name
            if not (folder / _READY).exists():
                _seen[name] = _seen.get(name, 0) + 1
                if _seen[name] == 2:
                    build_in_background(dynamics)
                return None
            packages = _load(folder, Signature.of(dynamics))
            if packages is None:
                return None
            _loaded[name] = packages
        return CompiledStep(dynamics, _loaded[name], lanes)

    def _call(self, name: str, w: Weights, x: State, drives: list, *rest: Tensor) -> list[Tensor]:
        weights = torch.tensor(w, dtype=torch.float64)
        state = [self._lanes(y.full if isinstance(y, Pair) else y) for y in x]
        laws = [part.contiguous() for pair in drives if pair is not None for part in pair]
        inputs = [self._lanes(y, 0 if i == 0 and name in _WITH_INVERSE else -1) for i, y in enumerate(rest)]
        # Flat inputs go past the package's own unpacking of nested lists, which costs as much as a small operation.
        outputs = self.packages[name].loader.boxed_run([weights, *state, *self.data, *laws, *inputs])
        if not self.twice:
            return outputs
        return [y[:1] if name == "matrix" else y[..., :1] for y in outputs]

    def _lanes(self, y: Tensor, axis: int = -1) -> Tensor:
        if self.twice:
            y = y.expand(2, *y.shape[1:]) if axis == 0 else y.expand(*y.shape[:-1], 2)
        return y.contiguous()

    def correct(self, w, data, x, H, z, drives):
        return tuple(self._call("correct", w, x, drives, H, z))

    def matrix(self, w, data, x, z, drives):
        return self._call("matrix", w, x, drives, z)[0]

    def tangent_first(self, w, data, x, H, z, drives):
        return tuple(self._call("tangent_first", w, x, drives, H, z))

    def tangent_next(self, w, data, x, H, z, drives, R, correction, dz):
        return tuple(self._call("tangent_next", w, x, drives, H, z, R, correction, dz))

    def finish(self, w, x, z):
        rest = (z.value, z.tangent) if isinstance(z, Pair) else (z,)
        drives = [
            (torch.ones(len(p.members[0]), 1, 1, dtype=torch.float64),) * 2 if p.driven else None
            for p in self.T.primitives
        ]
        return self.signature.state(self._call("finish", w, x, drives, *rest))


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
        step = Step(T, Saddle(T))
        for operation, kind in operations(signature).items():
            _package(kind(step, signature), operation, T, signature, target / f"{operation}.pt2")
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
    laws = [
        torch.ones(len(p.members[0]), 1, 1, dtype=torch.float64) for p in T.primitives if p.driven for _ in range(2)
    ]
    z, tangent = numbers(n, 1), [numbers(n, signature.tangents) for _ in range(3)]
    H = torch.rand(lanes, n, n, dtype=torch.float64)
    rest = {
        "correct": [H, z],
        "matrix": [z],
        "finish": [z, *tangent[: 1 if signature.tangents else 0]],
        "tangent_first": [H, z],
        "tangent_next": [H, z, *tangent],
    }[name]
    batch = torch.export.Dim("lanes", min=2, max=65536)
    dims = (
        None,
        [{2: batch}] * 5,
        [{x.dim() - 1: batch} for x in data],
        [None] * len(laws),
        [{0: batch} if x is H else {2: batch} for x in rest],
    )
    weights = torch.rand(len(Weights._fields), dtype=torch.float64)
    with torch.no_grad():
        program = torch.export.export(module, (weights, state, data, laws, rest), dynamic_shapes=dims, strict=False)
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
