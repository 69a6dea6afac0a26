"""A digest of all contents of an object: objects that compute the same numbers have the same digest.

    numbers      of tensors and arrays bit for bit, with their type and shape
    structure    classes, names and contents, in order; an object that occurs twice is written once
    functions    of a user: their text without comments and layout, defaults, closures and the globals that they use, also
                 those in modules of the user; classes of a user: their methods as well

torchmbd's own functions and classes are written by name (`source_digest` has their text), those of installed packages by name
and file. The place of a user's module has no influence, nor have comments, line numbers, the order of a dictionary or a set,
and the numbers of `ignored` tensors.
Attributes that follow from others have none either, so an object has the same digest before and after its use: cached
properties, those that a class names in `derived_state`, and `training` of torchmbd's modules, which none of them reads.
Checked in tests/math/test_digest.py.
"""

from __future__ import annotations

import ast
import enum
import hashlib
import inspect
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path, PurePath
from types import BuiltinFunctionType, FunctionType, MethodDescriptorType, MethodType, ModuleType
from typing import Any, get_args, get_origin

import numpy as np
import torch

from torchmbd.errors import warn

_NUMBERS = (bool, int, float, complex, str, bytes, range)
_ATOMS = (enum.Enum, type(None), *_NUMBERS, type(...), torch.dtype, torch.device, PurePath)
_METHODS = (FunctionType, classmethod, staticmethod, property)


def digest(*objects: Any, ignored: Iterable[Any] = ()) -> str:
    """Return the digest of objects, the same in every process; numbers of `ignored` tensors and arrays have no influence."""
    walk = _Walk()
    walk.ignored = {id(x) for x in ignored}
    walk.add(objects)
    return walk.hash.hexdigest()[:32]


def source_digest(folder: Path, without: Sequence[str] = ()) -> str:
    """Return the digest of all source files (Python, C++) of a folder but those in `without`: files, or folders of them."""
    hash = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        place = file.relative_to(folder)
        if file.suffix in (".py", ".cpp", ".h") and not any(place.is_relative_to(part) for part in without):
            hash.update(f"{place}\0".encode() + file.read_bytes() + b"\0")
    return hash.hexdigest()[:32]


class _Walk:
    """Writes the contents of objects into a hash, each object once."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self.ignored: set[int] = set()
        self._written: dict[int, int] = {}
        self._alive: list[Any] = []  # references, so that no other object gets the id of a written one

    def write(self, *words: object) -> None:
        self.hash.update("\0".join(map(str, (*words, ""))).encode(errors="surrogatepass"))

    def add(self, x: Any) -> None:
        if isinstance(x, _ATOMS):
            self.write(type(x).__name__, repr(x))
        elif isinstance(x, tuple):  # the interpreter may share equal tuples: they are written every time
            self.write(_name(type(x)), len(x))
            for y in x:
                self.add(y)
        elif id(x) in self._written:
            self.write("met", self._written[id(x)])
        else:
            self._written[id(x)] = len(self._written)
            self._alive.append(x)
            self._add_new(x)

    def _add_new(self, x: Any) -> None:
        if isinstance(x, (torch.Tensor, np.ndarray, np.generic)):
            self._add_numbers(x)
        elif isinstance(x, ModuleType):
            self.write("module", x.__name__)
        elif isinstance(x, type):
            self._add_class(x)
        elif isinstance(x, FunctionType):
            self._add_function(x)
        elif isinstance(x, MethodType):
            self.add((x.__self__, x.__func__))
        elif isinstance(x, (BuiltinFunctionType, MethodDescriptorType, np.ufunc)):
            self.write("builtin", getattr(x, "__qualname__", x.__name__))
            self.add(None if isinstance(owner := getattr(x, "__self__", None), ModuleType) else owner)
        elif isinstance(x, (classmethod, staticmethod)):
            self.add((type(x).__name__, x.__func__))
        elif isinstance(x, property):
            self.add(("property", x.fget, x.fset))
        elif isinstance(x, cached_property):
            self.add(("property", x.func))
        elif isinstance(x, partial):
            self.add(("partial", x.func, x.args, x.keywords))
        elif get_origin(x) is not None:  # a type with arguments, such as list[int]
            self.add(("alias", get_origin(x), get_args(x)))
        elif isinstance(x, Mapping):
            self.add(type(x))
            self._add_items(x)
        elif isinstance(x, (set, frozenset)):
            self.add(tuple(sorted(digest(y) for y in x)))
        elif isinstance(x, list):
            self.add(("list", *x))
        else:
            self._add_object(x)

    def _add_items(self, x: Mapping[Any, Any]) -> None:
        for key in sorted(x, key=lambda key: (type(key).__name__, repr(key))):
            self.add(key)
            self.add(x[key])

    def _add_numbers(self, x: torch.Tensor | np.ndarray | np.generic) -> None:
        self.write(_name(type(x)), x.dtype, tuple(x.shape))
        if id(x) in self.ignored:
            return
        if isinstance(x, torch.Tensor) and x.layout is not torch.strided:
            x = x.detach().to_sparse_coo().coalesce()
            self.add((x.indices(), x.values()))
        elif isinstance(x, torch.Tensor):
            plain = x.detach().cpu().resolve_conj().resolve_neg().contiguous()
            self.hash.update(plain.reshape(-1).view(torch.uint8).numpy().tobytes())
        elif x.dtype == object:
            self.add(x.tolist())
        else:
            self.hash.update(x.tobytes())

    def _add_object(self, x: Any) -> None:
        """An instance of a class: the state that pickling would keep, without what is derived of it."""
        kind = type(x)
        self.add(kind)
        state = x.__getstate__()
        parts = state if isinstance(state, tuple) else (state,)
        if state is None and not hasattr(x, "__dict__"):
            try:
                parts = x.__reduce_ex__(2)[1:]
            except (TypeError, RuntimeError):  # raised by Python and pybind11 for objects that cannot be pickled
                _warn_unseen(f"the contents of a {_name(kind)}", "tensors, arrays or numbers")
        for part in parts:
            if isinstance(part, dict):
                kept = {k: y for k, y in part.items() if not _is_derived(kind, k)}
                if isinstance(x, torch.nn.Module):  # torch numbers the hooks of a process
                    kept = {
                        k: tuple(y.values()) if "_hooks" in k and isinstance(y, dict) else y for k, y in kept.items()
                    }
                self._add_items(kept)
            else:
                self.add(part)

    def _add_class(self, x: type) -> None:
        self.write("class", _name(x))
        if _of_package(x.__module__) or self._installed(x.__module__):
            return
        self.add(x.__bases__)
        # Attributes that Python adds to a class, such as __doc__ or descriptors of slots, differ between versions.
        members = {k: y for k, y in vars(x).items() if isinstance(y, _METHODS) or (k[:2] != "__" and k != "_abc_impl")}
        added = (inspect.isgetsetdescriptor, inspect.ismemberdescriptor, lambda y: _is_generated(x, y))
        self._add_items({k: y for k, y in members.items() if not any(test(y) for test in added)})

    def _add_function(self, x: FunctionType) -> None:
        self.write("function", x.__qualname__)
        self.add((x.__defaults__, x.__kwdefaults__, _module_name(x.__module__)))
        for cell in x.__closure__ or ():
            try:
                self.add(cell.cell_contents)
            except ValueError:  # an empty cell
                self.write("empty")
        if _of_package(x.__module__) or self._installed(x.__module__):
            return
        definition = _definition(x)
        if definition is None:
            _warn_unseen(f"the text of the function {x.__qualname__}", "a function in a file")
            return
        self.write(ast.unparse(definition))
        self._add_named(x.__globals__, sorted(set(_names(definition))), set())

    def _add_named(self, space: Mapping[str, Any], names: Sequence[str], seen: set[int]) -> None:
        """Values of the names in a function: globals of its module, and attributes of modules of the user among them."""
        seen.add(id(space))
        for name in names:
            if name not in space:
                continue
            value = space[name]
            self.add((name, value))
            if not isinstance(value, ModuleType) or id(vars(value)) in seen:
                continue
            if not (_of_package(value.__name__) or self._installed(value.__name__)):
                self._add_named(vars(value), names, seen)

    def _installed(self, module: str) -> bool:
        """True if a module belongs to Python or an installed package; then the digest of its file is written."""
        file_digest = _installed_file(module)
        if file_digest is None:
            return False
        self.write(module, file_digest)
        return True


def _name(kind: type) -> str:
    return f"{_module_name(kind.__module__)}.{kind.__qualname__}"


def _module_name(module: str) -> str:
    """The name of a module of torchmbd, Python or an installed package, "" of a user's, which may lie anywhere."""
    return module if _of_package(module) or _installed_file(module) is not None else ""


def _of_package(module: str) -> bool:
    return module.partition(".")[0] == "torchmbd"


def _is_derived(kind: type, name: str) -> bool:
    """True if an attribute of instances of a class follows from others, or is a switch that the class does not read."""
    unread = name == "training" and _of_package(kind.__module__)
    named = name in getattr(kind, "derived_state", ())
    return unread or named or isinstance(_inherited(kind, name), cached_property)


def _inherited(kind: type, name: str) -> Any:
    """The attribute of a class or its bases, without descriptors being called; None if there is none."""
    return next((vars(base)[name] for base in kind.__mro__ if name in vars(base)), None)


def _definition(x: FunctionType) -> ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | None:
    """The definition of a function in the text of its file; None if the text is not available, as in `exec`."""
    code = x.__code__
    try:
        lines, _ = inspect.findsource(code)
        nodes = _definitions("".join(lines)).get((code.co_name, code.co_firstlineno), [])
    except (OSError, SyntaxError):
        return None
    if len(nodes) > 1:  # lambdas in one line: the smallest that has all places of the code
        places = [(line, column, end, last) for line, end, column, last in code.co_positions() if last]
        nodes = [y for y in nodes if all(_is_within(place, y.body) for place in places)]
        nodes.sort(key=lambda y: len(ast.unparse(y)))
    return nodes[0] if nodes else None


def _names(node: ast.AST) -> Iterator[str]:
    """Names and attributes in a definition, without those in annotations, which compute nothing."""
    if isinstance(node, (ast.Name, ast.Attribute)):
        yield node.id if isinstance(node, ast.Name) else node.attr
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns"):
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, ast.AST):
                    yield from _names(part)


def _is_within(place: tuple[Any, ...], node: ast.expr) -> bool:
    return (node.lineno, node.col_offset) <= place[:2] and place[2:] <= (node.end_lineno, node.end_col_offset)


@lru_cache(maxsize=32)
def _definitions(text: str) -> dict[tuple[str, int], list[Any]]:
    """The functions in a text, by their name and first line."""
    result: dict[tuple[str, int], list[Any]] = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Lambda):
            result.setdefault(("<lambda>", node.lineno), []).append(node)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            first = min([node.lineno, *(x.lineno for x in node.decorator_list)])
            result.setdefault((node.name, first), []).append(node)
    return result


def _is_generated(kind: type, member: Any) -> bool:
    """True if Python has written a method of a dataclass or a named tuple: its fields determine it."""
    method = inspect.unwrap(getattr(member, "__func__", member))
    named = isinstance(method, FunctionType) and method.__name__[:2] == "__"
    return named and (is_dataclass(kind) or issubclass(kind, tuple)) and _definition(method) is None


def _warn_unseen(part: str, allowed: str) -> None:
    warn(
        f"{part} in the model cannot be compared. If it changes, torchmbd uses stored evaluations that are out of date. "
        f"Try: {allowed}, or run --fresh"
    )


@cache
def _installed_file(module: str) -> str | None:
    """The digest of the file of an installed module, "" for one that has none; None for a user's own."""
    file = getattr(sys.modules.get(module), "__file__", None)
    if module.partition(".")[0] in sys.stdlib_module_names and module != "__main__":
        return ""
    if file is None:
        return None
    if not {"site-packages", "dist-packages"} & set(Path(file).parts):
        return None
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()
