"""The error for a wrong argument, and the warning, by their fields: their words may change, what they say of may not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from torchmbd.errors import InputError

ANY: Any = object()  # a value that is not asserted


@contextmanager
def refused(
    argument: str, value: Any = ANY, *facts: str, meant: str = "", kind: type[InputError] = InputError
) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Assert that an InputError is raised inside, for the argument of this path, as "beam.node", and with this value.

    facts    what the message must have besides: numbers, names, a file and its line
    meant    the name that the error proposes in place of a misspelt one
    kind     the class of the error
    """
    with pytest.raises(kind) as caught:
        yield caught
    error = caught.value
    assert error.argument == argument, f"{error.argument!r}, not {argument!r}: {error}"
    assert error.allowed != "" or error.hint or error.state, f"nothing is said to be allowed: {error}"
    if value is not ANY:
        assert repr(error.value) == repr(value), f"the value is {error.value!r}, not {value!r}: {error}"
    missing = [fact for fact in facts if fact not in str(error)]
    assert not missing, f"{missing} are missing: {error}"
    if meant:
        assert repr(meant) in error.hint, f"{meant!r} is not proposed: {error}"


@contextmanager
def warned(*facts: str, kind: type[Warning] = UserWarning) -> Iterator[pytest.WarningsRecorder]:
    """Assert a warning inside that has these facts: names of bodies, cards and arguments, numbers."""
    pattern = "".join(f"(?=.*{re.escape(fact)})" for fact in facts)
    with pytest.warns(kind, match=f"(?s){pattern}") as caught:
        yield caught
