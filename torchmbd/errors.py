"""Errors of torchmbd: raised where input enters, with the argument, its value and what is allowed.

A simulation or an optimization that fails later is not an exception: it is a status in the result.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import pickle
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")
_INSIDE = ("torchmbd", "torch", "scipy", "numpy", "contextlib", "functools")  # packages whose lines are not the user's


class MbdError(Exception):
    """Base of all errors that torchmbd raises.

    >>> issubclass(mbd.InputError, mbd.MbdError) and issubclass(mbd.SimulationFailure, mbd.MbdError)
    True
    """


Path = tuple[str | int, ...]  # keys to an argument: ("design", "rod.laminate.angles", "upper")
_ABSENT: Any = object()
_LONGEST = 400  # characters of a value in a message


class InputError(MbdError, ValueError):
    """An argument is wrong: the error has the argument, its value, what is allowed and a remedy as fields.

    path     the keys to the argument, the last of which is its name: ("design", "rod.laminate.angles", "upper")
    value    its value
    state    what is wrong with the value, if the value alone does not show it: "has shape [3]"
    allowed  what is required, in words that follow "must be": "a positive number", "0 to 1". Words that need another
             verb begin with "must": "must have one row for each node". A list has names: the value must be one of
             them, or the last key of the path must be one, if `state` is given
    hint     what the user can do, in words that follow "Try: "

    The message is written from these fields. It has one of three forms:

        argument = value: must be `allowed`. Try: `hint`
        argument `state`: must be `allowed`. Try: `hint`
        argument = value `state`: must be `allowed`. Try: `hint`

    A part of the message is left out if its field is empty.

    An error that was made of a sentence alone has an empty path, and its value is None.

    >>> mbd.examples.pendulum().body("bop")
    Traceback (most recent call last):
        ...
    torchmbd.errors.InputError: body = 'bop': must be bob. Try: 'bob'
    >>> try:
    ...     mbd.simulate(mbd.examples.pendulum(), duration=-1.0)
    ... except mbd.InputError as error:
    ...     print(error.argument, error.value, "|", error)
    duration -1.0 | duration = -1.0 s: must be a positive number
    """

    def __init__(
        self,
        argument: str | Path,
        value: Any = _ABSENT,
        allowed: str | Iterable[object] = "",
        hint: str = "",
        *,
        noun: str = "",
        shown: str | None = None,
        state: str = "",
    ):
        """Make the error of an argument, or of a sentence alone.

        argument  its name or the keys to it; a whole sentence where nothing else is given
        noun      the words for the argument in the message; default: its keys, with points between them
        shown     the value in the message, with its unit; "": the message is without the value; default: its repr, but "" if
                  there is a state
        state     what is wrong with the value: "has shape (3,)"; it follows the value if this is shown
        """
        self.value = None if value is _ABSENT else value
        self.allowed = allowed if isinstance(allowed, str) else tuple(map(str, allowed))
        self._is_sentence = value is _ABSENT and not state and allowed == "" and not hint
        keys = tuple(argument) if isinstance(argument, (tuple, list)) else (argument,)
        name = keys[-1] if state and keys else self.value
        self.hint = hint if isinstance(self.allowed, str) else _remedies(name, self.allowed, hint)
        self.path: Path = () if self._is_sentence else keys
        self._noun = str(argument) if self._is_sentence else noun
        self._shown = shown if shown is not None else "" if value is _ABSENT or state else _brief(value, _LONGEST)
        self._has_value, self.state = value is not _ABSENT, state
        super().__init__(str(self))

    def __reduce__(self) -> Any:
        """Other processes get the message and the fields, and words for a value that cannot be sent, such as a function."""
        return _received, (type(self), {**vars(self), "value": self._sent()}, self.args)

    def _sent(self) -> Any:
        value: Any = self.value
        value = value.detach() if getattr(value, "requires_grad", False) else value
        try:
            pickle.dumps(value)
        except (pickle.PicklingError, TypeError, AttributeError, RuntimeError):
            return repr(value)
        return value

    @property
    def argument(self) -> str:
        """The path, with points between its keys; "" if the error has none."""
        return dotted(self.path)

    @property
    def reason(self) -> str:
        """The message as it follows the argument's key in a file: "= -1.0 s: must be a positive number"."""
        if self._is_sentence:
            return f": {self}"
        what = " ".join(x for x in (f"= {self._shown}" if self._shown else "", self.state) if x)
        text = ": ".join(x for x in (what, must(self.allowed)) if x)
        return f"{text}. Try: {self.hint}" if self.hint else text

    def __str__(self) -> str:
        return self._noun if self._is_sentence else _joined(self._noun or self.argument, self.reason)


def must(allowed: str | Sequence[str]) -> str:
    """Return the clause of a message that says what is allowed: "must be a positive number"; "" for no words."""
    if not isinstance(allowed, str):
        if not allowed:
            return "must be left out, because there are no names"
        allowed = allowed[0] if len(allowed) == 1 else f"one of {', '.join(allowed)}"
    return allowed if not allowed or allowed.startswith("must ") else f"must be {allowed}"


def _joined(noun: str, reason: str) -> str:
    return f"{noun}{'' if reason.startswith(':') else ' '}{reason}"


def _received(kind: type[InputError], fields: dict[str, Any], args: tuple[Any, ...]) -> InputError:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


def dotted(path: Path) -> str:
    """Write a path as an experiment file's overrides do: `subject_to.0.at_most`."""
    return ".".join(map(str, path))


class SimulationFailure(MbdError):
    """A motion could not be computed: there are no numbers to return.

    A failed design of a batch gives a status, not an exception; `require_ok` turns the status into this error.

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> motion.require_ok() is motion  # raises SimulationFailure if a lane has failed
    True
    """


class DesignFailure(InputError, SimulationFailure):
    """A design does not have what is needed: an equilibrium, a critical speed, a derivative where frequencies coincide.

    It is an InputError for one design, and a SimulationFailure, whose status an optimizer gets, where designs are searched.

    >>> issubclass(mbd.DesignFailure, mbd.InputError)
    True
    """


_NEAR = 0.6  # least likeness of a name that a hint tells, as bop and bob; weigh and design have 0.55
_NEAR_BEGUN = 0.5  # the same of two names that begin with the same letter, as l0 and lo
_MISSPELT = (
    0.8  # likeness from which on a name is another with an error, as left_edgy; below, a longer word for it may be
)


# Arguments that have the meaning of a word of other programs.
_MEANINGS = {
    **dict.fromkeys(
        ("rotation", "rotate", "rotation_matrix", "orientation", "attitude", "quaternion"), ("axes", "turn")
    ),
    **dict.fromkeys(("origin", "location", "place", "translation"), ("position",)),
    **dict.fromkeys(("cog", "center_of_mass", "com"), ("center",)),
    **dict.fromkeys(("weight",), ("mass",)),
    **dict.fromkeys(("rho",), ("density",)),
    **dict.fromkeys(("k",), ("stiffness",)),
    **dict.fromkeys(("c",), ("damping",)),
}


def nearest(name: object, allowed: Iterable[object]) -> str:
    """Return the hint for an unknown name: the one of those allowed that is nearest to it, "" if none is near."""
    if isinstance(name, str) and name == "device":
        return "no device, because torchmbd computes on the CPU alone"
    close = _meant(str(name), [str(option) for option in allowed])
    return repr(close) if close else ""


def must_be_one(name: object, allowed: Iterable[object], hint: str = "") -> str:
    """Return the end of a message about an unknown name: "must be one of a, b. Try: 'a'".

    hint  another remedy
    """
    names = tuple(map(str, allowed))
    hint = _remedies(name, names, hint)
    return f"{must(names)}. Try: {hint}" if hint else must(names)


def _remedies(name: object, allowed: Iterable[object], hint: str) -> str:
    near = nearest(name, allowed)
    if hint == near or hint.startswith(
        f"{near}, or "
    ):  # of an error that is made again with another place, by `within`
        return hint
    return ", or ".join(x for x in (near, hint) if x)


def _meant(name: str, options: list[str]) -> str | None:
    """Return the option that a name means: by its meaning, else by its letters; None: none is near.

    Options that begin with another letter must be as near as by one error: duration is not what rotation means.
    """
    if name.lower() not in options:
        for meaning in _MEANINGS.get(name.lower(), ()):
            if meaning in options:
                return meaning
    close = _closest(name, options)
    letters, near = ("".join(filter(str.isalnum, x.lower())) for x in (name, close or ""))
    alike = letters[:1] == near[:1] or difflib.SequenceMatcher(None, letters, near).ratio() >= _MISSPELT
    return close if alike else None


def _closest(name: str, options: list[str]) -> str | None:
    """Return the option that is nearest to a name; None if none is near."""
    begun = [option for option in options if len(name) > 2 and _letters(option).startswith(_letters(name))]
    if len(begun) == 1:  # maxiter: max_iterations, not max_time
        return begun[0]
    close = _alike(name, options)
    if close and difflib.SequenceMatcher(None, name, close[0]).ratio() < _MISSPELT:
        close.sort(key=lambda option: len(option) < 3 or not name.startswith(option))  # degrees: deg, not deg/s
    if not close:  # a name in capitals is near to the same in small letters
        small = {option.lower(): option for option in reversed(options)}
        close = [small[x] for x in _alike(name.lower(), list(small))]
    return close[0] if close else None


def _alike(name: str, options: list[str]) -> list[str]:
    """Return up to three options that are near to a name, the nearest first."""
    begun = [option for option in options if option[:1] == name[:1]]
    close = {
        *difflib.get_close_matches(name, options, 3, _NEAR),
        *difflib.get_close_matches(name, begun, 3, _NEAR_BEGUN),
    }
    return difflib.get_close_matches(name, [option for option in options if option in close], 3, _NEAR_BEGUN)


def _letters(name: str) -> str:
    return name.replace("_", "").lower()


def one_of(kind: str | Path, name: object, allowed: Iterable[object]) -> str:
    """A name that is one of those allowed; InputError for any other, and for what is no name at all."""
    options = list(allowed)
    if not isinstance(name, str) or name not in options:
        raise unknown(kind, name, options)
    return name


def unknown(kind: str | Path, name: object, allowed: Iterable[object], path: Path = (), hint: str = "") -> InputError:
    """Build the error for a name that does not exist, with the nearest that does.

    kind  a word for what it names, or the keys to the argument
    path  the keys to the argument; default: `kind`
    hint  another remedy
    """
    return InputError(path or kind, name, list(allowed), hint, noun=kind if isinstance(kind, str) else "")


def not_installed(argument: str | Path, value: Any, what: str, package: str, remedy: str) -> InputError:
    """Build the error for what needs a package that is not installed; remedy: the command that installs it."""
    state = f"needs the package {package}, which is not installed"
    return InputError(argument, value, hint=remedy, noun=what, state=state)


def wrong_entry(place: object, fault: str, allowed: str = "", key: str = "", hint: str = "") -> InputError:
    """Build the error for an entry of a file of another program.

    place  the line, card or element, as the message names it
    key    the field or attribute there; "": the error is about the whole place
    """
    path = (str(place), key) if key else (str(place),)
    return InputError(path, allowed=allowed, hint=hint, noun=f"{place}:", state=fault)


def within(place: object, error: InputError, *keys: str | int) -> InputError:
    """Build the error of an argument within a place, such as a file, a card or a part, from the error that names it there.

    keys  the path to the place; default: its words
    """
    path = (*(keys or (str(place),)), *error.path)
    value = error.value if error._has_value else _ABSENT
    if error._is_sentence:
        return InputError(path, value, noun=f"{place}:", state=str(error))
    noun = f"{place}: {error._noun or error.argument}"
    return InputError(path, value, error.allowed, error.hint, noun=noun, shown=error._shown, state=error.state)


def true_or_false(name: str | Path, value: Any) -> bool:
    """Read a switch; InputError for words, numbers and None: bool() makes True of "no"."""
    if isinstance(value, bool):
        return value
    import numpy as np  # not above: the command line names its commands without it

    if not isinstance(value, np.bool_):
        raise InputError(name, value, "True or False")
    return bool(value)


class LoadWarning(UserWarning):
    """Loads of a body are large beside its stiffness. A study tells it in its answer instead, once."""


_kinds: ContextVar[set[str] | None] = ContextVar("kinds", default=None)  # of warnings, inside `warnings_once`
_NUMBER = re.compile(r"(?<!\w)[-+]?\d[\d.,]*(?:e[-+]?\d+)?")  # not of a name: part_0 and part_1 are two bodies


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn of something at the line outside of torchmbd (and torch and scipy, which call it back) that led to it."""
    kinds = _kinds.get()
    if kinds is not None:
        kind = _NUMBER.sub("#", text)
        if kind in kinds:
            return
        kinds.add(kind)
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level)


@contextmanager
def warnings_once() -> Iterator[None]:
    """Warnings of torchmbd that differ in their numbers alone are one inside: a search makes many motions of one model.

    Inside another `warnings_once` it changes nothing: a study is one, with its searches. Serves as a decorator as well.
    """
    if _kinds.get() is not None:
        yield
        return
    token = _kinds.set(set())
    try:
        yield
    finally:
        _kinds.reset(token)


def user_line(error: BaseException) -> str:
    """Return "file:line" where a function of a user raised an error, or called what did."""
    frames = list(traceback.walk_tb(error.__traceback__))
    outside = [x for x in frames if x[0].f_globals.get("__name__", "").partition(".")[0] not in _INSIDE]
    frame, line = (outside or frames)[-1]
    return f"{frame.f_code.co_filename}:{line}"


@functools.cache
def argument_names(function: Callable[..., Any]) -> tuple[str, ...]:
    """The arguments of a function that have names, without those that it takes as options."""
    parameters = inspect.signature(function).parameters.values()
    return tuple(p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY))


def keyword_hints(x: T) -> T:
    """Decorator of a function or class that many programs call: the TypeError of a keyword that does not exist gets the nearest
    name as a note.

    A class has its constructor and its class methods decorated.

    >>> try:
    ...     mbd.sections.tube(0.02, mbd.Ply.isotropic(70e9, 0.3, 2700.0), [0.0], thicknes=1e-3)
    ... except TypeError as error:
    ...     print(*error.__notes__)
    Try: thickness = ... in place of thicknes = 0.001.
    """
    if isinstance(x, type):
        constructed: Any = x
        constructed.__init__ = keyword_hints(constructed.__init__)
        for name, member in list(vars(x).items()):
            if isinstance(member, classmethod) and name[0] != "_":
                setattr(x, name, classmethod(keyword_hints(member.__func__)))
        return x
    function: Any = x

    takes_options = any(x.kind is x.VAR_KEYWORD for x in inspect.signature(function).parameters.values())

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        unknown = {key: value for key, value in kwargs.items() if key not in argument_names(function)}
        if unknown and not takes_options:
            shown = type(args[0]).__name__ if function.__name__ == "__init__" else function.__qualname__
            error = TypeError(f"{shown}() got an unexpected keyword argument {next(iter(unknown))!r}")
            _add_names(error, function, unknown)
            raise error
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            _add_names(error, function, unknown)
            raise

    return call  # type: ignore[return-value]


class HintedKeywords:
    """Base of families of classes: the constructor of each subclass has `keyword_hints`."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            constructed: Any = cls
            constructed.__init__ = keyword_hints(constructed.__init__)


def _add_names(error: TypeError, function: Callable[..., Any], unknown: dict[str, Any]) -> None:
    """Add the argument whose name is nearest to each keyword that does not exist."""
    for key, value in unknown.items():
        if name := meant_argument(key, function):
            error.add_note(f"Try: {name} = ... in place of {key} = {_brief(value)}.")


def meant_argument(keyword: str, function: Callable[..., Any]) -> str | None:
    """Return the argument of a function that a keyword means which is none of them; None: none is near."""
    return _meant(keyword, list(argument_names(function)))


def _brief(x: object, longest: int = 60) -> str:
    text, more, _ = repr(x).partition("\n")
    return text if len(text) <= longest and not more else f"{text[: longest - 3]}..."
