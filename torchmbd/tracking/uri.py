"""The URI of a tracking store, which may hold a user and a password: its text never shows them.

    StoreURI("postgresql://me:secret@host/runs")    prints, formats and is written as postgresql://***@host/runs
        .whole                                      with the user part: for MLflow alone
        .page                                       without: for a browser
    hidden(text)                                    any text, the user part of every URI in it hidden

A query is hidden, too: databases take passwords there.
Checked in tests/tracking/test_uri.py, tests/study/record/test_credentials.py.
"""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

from torchmbd.process import file_of

MASK = "***"
# Up to the last @: a password may hold one.
_USER = re.compile(r"(?<![\w+.-])(?!(?:sqlite|file):)([A-Za-z][\w+.-]*://)\S*@")
_QUERY = re.compile(
    r"(?<![\w+.-])((?!sqlite)(?:https?|databricks|postgresql|mysql|mssql)[\w+.-]*://[^\s?]*\?)(?!\*)[^\s'\"]+"
)


class StoreURI:
    """A URI of a store; `uri` may be one already."""

    def __init__(self, uri: str | StoreURI) -> None:
        self.whole: str = uri.whole if isinstance(uri, StoreURI) else uri

    def __str__(self) -> str:
        scheme, separator, rest = self.whole.partition("://")
        if (
            scheme.startswith("sqlite") or not separator
        ):  # a path; without a scheme it is no URI, and may be a password still
            return self.whole if separator else self.whole.rpartition("@")[2]
        _, at, place = rest.rpartition("@")
        return hidden(f"{scheme}://{MASK if at else ''}{at}{place}")

    def __repr__(self) -> str:
        return repr(str(self))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StoreURI) and self.whole == other.whole

    def __hash__(self) -> int:
        return hash(self.whole)

    @property
    def masked(self) -> bool:
        """True if the URI is a text of another one, so that its user part is lost."""
        return f"{MASK}@" in self.whole or self.whole.endswith(f"?{MASK}")

    @property
    def served(self) -> bool:
        """True if the store is a server of MLflow."""
        return self.whole.startswith(("http:", "https:"))

    @property
    def page(self) -> str:
        """The address of a server in a browser."""
        return str(self).replace(f"{MASK}@", "").partition("?")[0].rstrip("/")

    @property
    def file(self) -> Path | None:
        """The file of a SQLite store (absolute), None for any other store."""
        return (
            file_of(self.whole.removeprefix("sqlite:///")).absolute() if self.whole.startswith("sqlite:///") else None
        )

    def hide(self, text: str) -> str:
        """Return a text, such as a message of a database, without user and password of this URI."""
        text = text.replace(self.whole, str(self))
        rest = self.whole.partition("://")[2]
        user, at, place = rest.rpartition("@")
        words = [user, *user.split(":", 1)] if at and self.file is None else []
        words += [value.partition("=")[2] for value in place.partition("?")[2].split("&") if self.file is None]
        for word in sorted(
            {word for secret in words for word in (secret, unquote(secret)) if word}, key=len, reverse=True
        ):
            text = re.sub(rf"(?<!\w){re.escape(word)}(?!\w)", MASK, text)
        return hidden(text)


def hidden(text: str) -> str:
    """Return a text with the user part and the query of every URI in it hidden."""
    return _QUERY.sub(rf"\g<1>{MASK}", _USER.sub(rf"\g<1>{MASK}@", text))
