"""Functions of the user that an experiment file names: the model, its phases, responses and figures.

package.module:function      as Python finds it
path/to/file.py:function     in the folder of the experiment file or below it

Not every function may be called from a file: only one written in Python, with an annotation of what it returns,
`-> mbd.System` for a model. The named file is executed, with all rights of the user, and once for all functions of an
experiment, which share its globals. It can import the modules beside it, which replace no module of Python or of a package.
Checked in tests/study/file/test_load.py, test_malicious.py.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from torchmbd.design import History, Measure
from torchmbd.errors import InputError, must, must_be_one, nearest, user_line, within
from torchmbd.integrate import Phase
from torchmbd.multibody.system import System
from torchmbd.process import file_of
from torchmbd.study.file.faults import Fault, shown

Builder = Callable[..., System]
_LONGEST = 400  # characters of a file's path in a message: its name is at the end
_executed: dict[Path, ModuleType] = {}  # files that the present experiment names
_imported: set[str] = set()  # names of the modules that these imported from their folders


def forget_files() -> None:
    """Forget the files of an earlier experiment, and the modules that they imported: either may have changed."""
    for name in _imported:
        sys.modules.pop(name, None)
    _imported.clear()
    _executed.clear()


def find_model(spec: str, folder: Path) -> Builder:
    """Return the function of the model that `spec` names; InputError if there is none."""
    function = find_function(spec, folder)
    require_returns(spec, function, ("System",))
    return cast(Builder, function)


def find_phases(spec: str, folder: Path) -> list[Phase]:
    """Return the phases that the function named by `spec` returns; InputError, whatever the function raises."""
    function = find_function(spec, folder)
    require_returns(spec, function, ("list",))
    with _user_code():
        phases = function()
    if not isinstance(phases, list) or not all(isinstance(phase, Phase) for phase in phases):
        raise _refused(spec, f"returns {phases!r}", "must return a list of mbd.Phase")
    return phases


def find_response(spec: str, folder: Path) -> Any:
    """Return the function that `spec` names, or the response, such as one made by `@mbd.history`."""
    named = _named(spec, folder)
    return named if isinstance(named, (History, Measure)) else find_function(spec, folder)


def find_function(spec: str, folder: Path) -> Callable[..., Any]:
    """Return the Python function that `spec` names, of a module or of a file below `folder`."""
    function = _named(spec, folder)
    if not inspect.isfunction(function):
        module_name, _, function_name = spec.rpartition(":")
        module = _module(module_name, folder)
        functions = [name for name, value in vars(module).items() if inspect.isfunction(value) and name[0] != "_"]
        state = f"names no function of {module_name}"
        raise _refused(spec, state, must(functions), nearest(function_name, functions))
    return function


def _refused(spec: str, state: str = "", allowed: str = "", hint: str = "") -> InputError:
    """Return the error of the name of a function; the key that has the name is the reader's.

    state   words after the name
    """
    return InputError((), spec, allowed, hint, noun="function", shown=shown(spec, _LONGEST), state=state)


def _named(spec: str, folder: Path) -> Any:
    """Return the object that `spec` names, None if the module has no such name."""
    module_name, _, name = spec.rpartition(":")
    if not module_name or not name:
        raise _refused(spec, allowed="package.module:function or path/to/file.py:function")
    return getattr(_module(module_name, folder), name, None)


def _module(name: str, folder: Path) -> ModuleType:
    return _from_file(_inside(name, folder)) if name.endswith(".py") else _from_name(name)


def require_returns(spec: str, function: Callable[..., Any], allowed: tuple[str, ...]) -> None:
    """InputError unless a function is annotated to return one of the `allowed` types."""
    annotation = function.__annotations__.get("return")
    name = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", repr(annotation))
    if annotation is None or name.partition("[")[0].rpartition(".")[2] not in allowed:
        returned = "nothing" if annotation is None else f"-> {name}"
        types = " or ".join(allowed)
        raise _refused(spec, f"says {returned} about what it returns", f"annotated with -> {types}")


def _inside(name: str, folder: Path) -> Path:
    """Return the path of a file below the folder; InputError for one that lies outside."""
    file = (folder / file_of(name)).resolve()
    if file_of(name).is_absolute() or not file.is_relative_to(folder.resolve()):
        allowed = f"a Python file in {folder} or below, or an importable module"
        raise _refused(name, "lies outside the folder of the experiment file", allowed)
    return file


def option_faults(builder: Builder, options: Mapping[str, Any]) -> list[Fault]:
    """Return the options that the function has no argument for, and its arguments that are missing, as faults."""
    parameters = inspect.signature(builder).parameters.values()
    named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    faults = []
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        names = [p.name for p in named]
        faults = [
            Fault(("options", key), f"= {shown(options[key])} is not an option: {must_be_one(key, names)}")
            for key in options
            if key not in names
        ]
    missing = [p.name for p in named if p.default is p.empty and p.name not in options]
    return faults + [
        Fault(("options", name), "is missing, and the model has no default for it: must be given") for name in missing
    ]


def build_model(builder: Builder, options: Mapping[str, Any]) -> System:
    """Build the system; InputError, whatever the function raises."""
    with _user_code():
        system = builder(**options)
    if not isinstance(system, System):
        raise InputError((), system, "a torchmbd.System", noun="the model", state=f"returned {type(system).__name__}")
    return system


@contextmanager
def _user_code() -> Iterator[None]:
    """Raise any exception of the user's code as an InputError that names its file and line."""
    try:
        yield
    except InputError as error:
        raise within(f"the function in {user_line(error)}", error) from error
    except Exception as error:
        state = f"raised {type(error).__name__} in {user_line(error)}: {error}"
        raise InputError((), noun="the function", state=state) from error


def scenario_systems(
    model: str, options: Mapping[str, Any], scenarios: Sequence[Any], folder: Path, change: Callable[[System], System]
) -> list[System | None]:
    """Return the system of each scenario that has options, None for others; equal options share a system.

    change   what is done to each system that was built
    """
    builder, built = find_model(model, folder), {}
    for scenario in scenarios:
        key = repr(sorted(scenario.options.items()))
        if scenario.options and key not in built:
            built[key] = change(build_model(builder, {**options, **scenario.options}))
    return [built.get(repr(sorted(s.options.items()))) if s.options else None for s in scenarios]


def _from_name(name: str) -> ModuleType:
    """A module that is installed, or in the working directory as for `python -m`."""
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.append(folder)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        allowed = "an importable module, or a Python file beside the experiment file"
        raise _refused(name, f"cannot be imported ({error})", allowed) from None
    except Exception as error:
        raise _refused(name, f"cannot be imported ({type(error).__name__}: {error})") from error


def _from_file(file: Path) -> ModuleType:
    if not file.is_file():
        raise _refused(str(file), "does not exist", "a Python file, relative to the experiment file")
    module = _executed.get(file) or _imported_from(file)
    if module is not None:
        return module
    place = hashlib.sha256(os.fsencode(file)).hexdigest()[:8]  # files of other folders may have the same stem
    name = f"torchmbd_model_{file.stem}_{place}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = _executed[file] = module  # dataclasses and pickle look their module up
    try:
        with _modules_beside(file.parent):
            spec.loader.exec_module(module)
    except Exception as error:
        del _executed[file]
        raise _refused(str(file), f"cannot be imported ({type(error).__name__}: {error})") from error
    return module


def _imported_from(file: Path) -> ModuleType | None:
    """The module of a file that another file of the experiment has imported; None: none has."""
    modules = (sys.modules[name] for name in _imported if name in sys.modules)
    return next((module for module in modules if getattr(module, "__file__", None) == str(file)), None)


@contextmanager
def _modules_beside(folder: Path) -> Iterator[None]:
    """Let a model import the modules of its folder, in their present version; files that were executed are such modules.

    Modules that a file of another folder has imported are forgotten, as theirs may have the same names. The folder is last on
    the path, so that its files replace no module of Python. No bytecode is written: Python does not notice a change within a
    second of it.
    """
    for name in sorted(_imported):
        if not Path(str(getattr(sys.modules.get(name), "__file__", ""))).is_relative_to(folder):
            sys.modules.pop(name, None)
            _imported.remove(name)
    executed = {file.stem: module for file, module in _executed.items() if file.parent == folder}
    executed = {name: module for name, module in executed.items() if name not in sys.modules}
    sys.modules.update(executed)
    before, writes = set(sys.modules), sys.dont_write_bytecode
    sys.path.append(str(folder))
    sys.dont_write_bytecode = True
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.dont_write_bytecode = writes
        sys.path.remove(str(folder))
        for name in executed:
            sys.modules.pop(name, None)
        files = {name: getattr(sys.modules[name], "__file__", None) for name in set(sys.modules) - before}
        _imported.update(name for name, file in files.items() if file and Path(file).is_relative_to(folder))
