"""The experiment files of a folder, each with the question in its first comment."""

from __future__ import annotations

from pathlib import Path

QUESTION_MISSING = "(opens with no question)"
RUNS = "mlartifacts"  # folder of the files of runs, copies of experiment files among them


def configs(folder: str | Path) -> dict[Path, str]:
    """Return the experiment files below a folder and the first comment of each."""
    files = sorted(file for pattern in ("*.yaml", "*.yml") for file in Path(folder).rglob(pattern))
    experiments = (file for file in files if not any(x == RUNS or x[0] == "." for x in file.relative_to(folder).parts))
    return {file: question(file) or QUESTION_MISSING for file in experiments}


def question(file: Path) -> str:
    """Return the first comment line of a file, "" if it opens with none, or is not there."""
    if not file.is_file():
        return ""
    with file.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith("#"):
                return line.lstrip("# ").strip()
            if line.strip():
                break
    return ""
