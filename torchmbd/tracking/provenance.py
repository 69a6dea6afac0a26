"""Tags of a run about its origin: versions, machine, and the git commit of the experiment file."""

from __future__ import annotations

import getpass
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

PACKAGES = ("torch", "torchdiffeq", "numpy", "scipy", "nlopt", "pydantic", "mlflow")


def provenance(folder: str | Path = ".") -> dict[str, str]:
    """Return tags for a run: `version.torch`, `git_commit` (with "+changes" if files differ from it), machine, user."""
    tags = {f"version.{name}": version for name in PACKAGES if (version := version_of(name))}
    tags["version.python"] = platform.python_version()
    tags["version.torchmbd"] = version_of("torchmbd") or "source"
    tags["machine"] = f"{platform.node()} ({platform.machine()}, {os.cpu_count()} cores)"
    tags["mlflow.user"] = _user()
    commit = _git(folder, "rev-parse", "HEAD")
    if commit:
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
        tags["git_commit"] = f"{commit}+changes" if changed else commit
        tags["mlflow.source.git.commit"] = commit  # the column "Version" of the UI
    return tags


def _user() -> str:
    """Return the user's name, or number where the system has no name for it, as in a container."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def version_of(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _git(folder: str | Path, *arguments: str) -> str | None:
    """Return the answer of git, or None where there is no git or no repository."""
    try:
        answer = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
