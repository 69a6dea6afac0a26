"""The text of a store's URI, and of messages about it, never shows user or password."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from tests.refused import refused
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.uri import StoreURI, hidden

CASES = {
    "http://alice:s3cret@host:5000": "http://***@host:5000",
    "https://s3cret@host/mlflow": "https://***@host/mlflow",
    "postgresql+psycopg2://alice:s3cret@host/runs": "postgresql+psycopg2://***@host/runs",
    "mysql://alice:s3c@re/t#?@host/runs": "mysql://***@host/runs",
    "postgresql://alice:s3cret%40@host/runs?sslmode=require&password=s3cret": "postgresql://***@host/runs?***",
    "mssql+pyodbc:///?odbc_connect=UID%3Dalice%3BPWD%3Ds3cret": "mssql+pyodbc:///?***",
    "http://host:5000": "http://host:5000",
    "sqlite:////home/me@work/mlflow.db": "sqlite:////home/me@work/mlflow.db",
}


@pytest.mark.parametrize(("whole", "text"), CASES.items())
def test_the_text_has_no_user(whole, text):
    uri = StoreURI(whole)
    assert [str(uri), f"{uri}", "%s" % uri, format(uri)] == [text] * 4  # noqa: UP031
    assert repr(uri) == repr(text)
    assert uri.whole == whole == StoreURI(uri).whole == pickle.loads(pickle.dumps(uri)).whole
    assert hidden(f"at '{whole}' it ends".replace("'mysql", "mysql")) in (f"at '{text}' it ends", f"at {text}' it ends")
    assert "alice" not in uri.page
    assert uri.masked is False
    assert StoreURI(text).masked is (text != whole)


def test_messages_of_databases_have_no_user():
    uri = StoreURI("postgresql://alice:s3cr%23et@host/runs?sslpassword=hush")
    told = f'{uri.whole}: connection failed: password "s3cr#et" (s3cr%23et) of user "alice" and hush; malice is a word'
    assert uri.hide(told) == f'{uri}: connection failed: password "***" (***) of user "***" and ***; malice is a word'


def test_a_text_that_was_written_is_no_store():
    with refused("uri", "postgresql://***@host/runs"):
        store_uri("postgresql://***@host/runs")


@pytest.mark.parametrize(
    "wrong", ["postgres://alice:s3cret@host/runs", "alice:s3cret@host/runs", "http//alice:s3cret@host"]
)
def test_a_uri_that_is_none_is_named_without_its_user(wrong, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", wrong)
    with refused("MLFLOW_TRACKING_URI") as caught:
        store_uri()
    assert "s3cret" not in str(caught.value)


def test_files_of_a_sqlite_store_are_beside_it(tmp_path):
    assert StoreURI(f"sqlite:///{tmp_path}/runs.db").file == Path(tmp_path) / "runs.db"
    assert StoreURI("http://host").file is None
