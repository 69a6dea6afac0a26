"""The error for a wrong argument, by its fields: its words may change, what they say of may not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from torchmbd.errors import InputError, nearest

_ANY: Any = object()


@contextmanager
def refused(argument: str, value: Any = _ANY, *, meant: str = "") -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Assert that an InputError is raised inside, for the argument of this path, as "beam.node", and with this value.

    meant    the name that the error proposes in place of a misspelt one
    """
    with pytest.raises(InputError) as caught:
        yield caught
    error = caught.value
    assert error.argument == argument, f"{error.argument!r}, not {argument!r}: {error}"
    assert error.allowed != "" or error.rule, f"nothing is said to be allowed: {error}"
    if value is not _ANY:
        assert repr(error.value) == repr(value), f"the value is {error.value!r}, not {value!r}: {error}"
    if meant:
        assert nearest(error.value, error.allowed).endswith(f"; did you mean {meant!r}?"), (
            f"{meant!r} is not proposed: {error}"
        )
