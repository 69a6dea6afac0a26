"""Tags that tell where a result comes from, and links that are legal addresses."""

from __future__ import annotations

import getpass
import os
import subprocess
from urllib.parse import parse_qs, urlsplit

import pytest
import torch

from torchmbd.tracking.links import compare_link, experiment_link, run_link, view_link
from torchmbd.tracking.provenance import provenance


@pytest.fixture
def repository(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        return subprocess.run(
            ["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    git("init", "-q")
    (tmp_path / "study.yaml").write_text("a: 1\n")
    git("add", ".")
    git("commit", "-q", "-m", "one")
    return tmp_path, git


def test_the_commit_of_the_folder_is_named_and_whether_files_differ_from_it(repository):
    folder, git = repository
    commit = git("rev-parse", "HEAD").strip()
    assert provenance(folder)["git_commit"] == commit
    (folder / "study.yaml").write_text("a: 2\n")
    assert provenance(folder)["git_commit"] == f"{commit}+changes"


@pytest.mark.parametrize("error", [KeyError("getpwuid(): uid not found: 12345"), OSError("No username set")])
def test_a_user_without_a_name_has_a_number(tmp_path, monkeypatch, error):
    """Python says it by KeyError up to 3.12, by OSError since."""

    def nameless():
        raise error

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert provenance(tmp_path)["mlflow.user"] == str(os.getuid())


def test_without_a_repository_there_is_no_commit(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    tags = provenance(tmp_path)
    assert "git_commit" not in tags
    assert tags["version.torch"] == torch.__version__


def query(link):
    """Split the part behind `#`, which is what the UI reads."""
    fragment = urlsplit(link).fragment
    path, _, text = fragment.partition("?")
    return path, {key: value[0] for key, value in parse_qs(text).items()}


def test_links_open_the_mode_that_has_tables():
    base = "http://127.0.0.1:5000"
    path, facets = query(experiment_link(base, "3"))
    assert path == "/experiments/3/runs"
    assert facets == {"workflowType": "machine_learning", "orderByKey": "metrics.`objective`", "orderByAsc": "true"}
    path, facets = query(view_link(base, "3", "abc", charts=True))
    assert facets == {"workflowType": "machine_learning", "viewStateShareKey": "abc", "compareRunsMode": "CHART"}
    path, facets = query(run_link(base, "3", "abc", "artifacts/motion.html"))
    assert path == "/experiments/3/runs/abc/artifacts/motion.html"
    path, facets = query(compare_link(base, "3", ["a", "b"]))
    assert (path, facets["runs"], facets["experiments"]) == ("/compare-runs", '["a","b"]', '["3"]')
