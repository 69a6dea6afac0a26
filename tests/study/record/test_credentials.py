"""User and password of a tracking store are in nothing that a study writes, sends or prints."""

from __future__ import annotations

import os
import shutil
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from torchmbd import cli
from torchmbd.study.file.yaml_file import parse_yaml, without_user
from torchmbd.tracking.server import serving

SECRETS = "alice", "s3cret"
SHORT = ["simulate.duration=0.002", "simulate.steps=8", "optimizer.max_iterations=1"]


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(autouse=True)
def place(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TORCHMBD_STORE")
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


def leaks(folder: Path, *but: Path) -> list[Path]:
    """The files that hold a secret."""
    files = [file for file in folder.rglob("*") if file.is_file() and file not in but]
    return [file for file in files if any(secret.encode() in file.read_bytes() for secret in SECRETS)]


def said(capsys) -> str:
    output = "".join(capsys.readouterr())
    assert not [secret for secret in SECRETS if secret in output], output
    return output


def modes(folder: Path) -> set[int]:
    """Modes of the folder of the studies, and of all that is in it."""
    place = folder / ".torchmbd"
    modes = [(path.is_dir(), stat.S_IMODE(path.stat().st_mode)) for path in (place, *place.iterdir())]
    assert {mode for is_folder, mode in modes if not is_folder} == {0o600}
    return {mode for is_folder, mode in modes if is_folder}


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["file", "override", "environment"])
def test_a_store_that_does_not_answer(write, folder, monkeypatch, capsys, way, port):
    """What is on disk and on the terminal, `torchmbd sync` and a study that goes on included."""
    uri = f"http://alice:s3cret@127.0.0.1:{port}"
    file = write(tracking={"experiment": "e"} | ({"uri": uri} if way == "file" else {}))
    overrides = [f"tracking.uri={uri}"] if way == "override" else []
    if way == "environment":
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    assert cli.main(["run", "study.yaml", *overrides, *SHORT]) == 1
    assert f"http://***@127.0.0.1:{port}" in said(capsys)
    assert cli.main(["sync"]) == 1
    assert ("MLFLOW_TRACKING_URI" if way == "override" else "cannot be opened") in said(capsys)
    for command in ("list", "best"):
        assert cli.main([command, "--uri", uri]) == 1
        assert "cannot be opened" in said(capsys)
    assert not leaks(folder, file)
    assert modes(folder) == {0o700}
    if way == "environment":
        monkeypatch.delenv("MLFLOW_TRACKING_URI")
        assert cli.main(["sync"]) == 1
        assert "Try: the whole URI as MLFLOW_TRACKING_URI" in said(capsys)


@pytest.mark.slow
def test_a_server_gets_no_password(write, folder, empty_store, monkeypatch, capsys, port):
    """Runs, parameters, files, links, the report and the lists; and `sync` finds the user again."""
    (folder / "server").mkdir()
    store, uri = f"sqlite:///{shutil.copy(empty_store, folder / 'server')}", f"http://alice:s3cret@127.0.0.1:{port}"
    file = write(tracking={"experiment": "e", "uri": uri})
    monkeypatch.setenv("TORCHMBD_PATIENCE", "60")
    with serving(store, port=port):
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
        command = [sys.executable, "-m", "torchmbd.cli", "run", "study.yaml", *SHORT]
        output = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert output.returncode in (0, cli.EXIT_UNVERIFIED), output
        assert not any(secret in output.stdout + output.stderr for secret in SECRETS)
        assert f" http://127.0.0.1:{port}/#/experiments/" in output.stdout
        assert "View run" not in output.stdout
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
        for arguments in (["list"], ["best"], ["ui"], ["report", "study", "--output", "report.html"]):
            assert cli.main(arguments) == 0
            said(capsys)
        assert cli.main(["run", "study.yaml", *SHORT]) in (0, cli.EXIT_UNVERIFIED)
        assert "nothing is run again" in said(capsys)
    assert not leaks(folder, file)
    assert f"http://***@127.0.0.1:{port}" in (folder / "report.html").read_text()


@pytest.mark.parametrize(
    "tracking",
    [
        "{experiment: e, uri: 'http://alice:s3cret@host'}",
        '{experiment: e, uri: "http://alice:s3\\x63ret@host"}',
        "\n  # it was uri: mysql://alice:s3cret@other/db\n  uri:\n    http://alice:s3cret@host # of alice:s3cret@host\n",
    ],
)
def test_the_copy_of_the_file_has_no_user(tracking):
    copy = without_user(f"# A question\ntracking: {tracking}\noptions: {{}}\n")
    assert parse_yaml(copy).data["tracking"]["uri"] == "http://***@host"
    assert "s3cret" not in copy.replace("# of alice:s3cret@host", "")
    assert copy.startswith("# A question\n")


@pytest.mark.parametrize(
    "tracking",
    [
        {"uri": "http:/alice:s3cret@host"},
        {"uri": "postgres://alice:s3cret@a-host-with-a-name-that-is-too-long-for-a-line-of-a-message/db"},
        {"uri": "alice:s3cret@host"},
        {"url": "http://alice:s3cret-that-is-so-long-that-a-message-leaves-the-end-out-of-it@host"},
        {"uri": ["http://alice:s3cret@host"]},
        "http://alice:s3cret@host",
    ],
)
def test_faults_show_no_user(write, folder, capsys, tracking):
    write(tracking=tracking)
    assert cli.main(["check", "study.yaml"]) == 2
    assert "tracking" in said(capsys)
    assert cli.main(["check", "study.yaml", "tracking={uri: 'http://alice:s3cret@host', no: 1}"]) == 2
    assert "tracking.no" in said(capsys)
