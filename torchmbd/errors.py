"""Errors of torchmbd: raised where input enters, with the argument, its value and what is allowed.

A simulation or an optimization that fails later is no exception: it is a status in the result.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class MbdError(Exception):
    """Base of all errors that torchmbd raises on purpose.

    >>> issubclass(mbd.InputError, mbd.MbdError) and issubclass(mbd.SimulationFailure, mbd.MbdError)
    True
    """


class InputError(MbdError, ValueError):
    """An argument is wrong. The message names the argument, the value and what is allowed.

    >>> mbd.examples.pendulum().body("bop")
    Traceback (most recent call last):
        ...
    torchmbd.errors.InputError: body 'bop' does not exist; allowed: bob; did you mean 'bob'?
    """


class SimulationFailure(MbdError):
    """A motion could not be computed: no numbers exist that could be returned.

    A failure of single designs of a batch is no exception but a status; `require_ok` turns it into this error.

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> motion.require_ok() is motion  # raises SimulationFailure where a lane has failed
    True
    """


def nearest(name: object, allowed: Iterable[object]) -> str:
    """Return `"; allowed: ...; did you mean 'x'?"` for the end of a message about an unknown name."""
    options = [str(option) for option in allowed]
    close = difflib.get_close_matches(str(name), options, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"; allowed: {', '.join(options) or '(none)'}{hint}"


def one_of(kind: str, name: object, allowed: Iterable[object]) -> str:
    """A name that is one of those allowed; InputError for any other, and for what is no name at all."""
    options = list(allowed)
    if not isinstance(name, str) or name not in options:
        raise unknown(kind, name, options)
    return name


def unknown(kind: str, name: object, allowed: Iterable[object]) -> InputError:
    """Build the error for a name that does not exist, with the nearest that does."""
    return InputError(f"{kind} {name!r} does not exist{nearest(name, allowed)}")
