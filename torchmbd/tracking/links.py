"""Links that open MLflow's UI in the view that is wanted.

Left to itself the UI (3.17) opens an experiment in its mode for language models and folds the children of a run.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from urllib.parse import quote

DEFAULT_BASE = "http://127.0.0.1:5000"


def experiment_link(base: str, experiment_id: str, parent_run: str | None = None, metric: str = "objective") -> str:
    """Return the table of runs ordered by a metric; with `parent_run` only the children of that study."""
    query = f"workflowType=machine_learning&orderByKey={quote(f'metrics.`{metric}`')}&orderByAsc=true"
    if parent_run is not None:
        query += "&searchFilter=" + quote(f'tags.mlflow.parentRunId = "{parent_run}"')
    return f"{base}/#/experiments/{experiment_id}/runs?{query}"


def run_link(base: str, experiment_id: str, run: str, view: str = "model-metrics") -> str:
    """Return one run; `view` "model-metrics" shows its charts, "artifacts" its files."""
    return f"{base}/#/experiments/{experiment_id}/runs/{run}/{view}"


def compare_link(base: str, experiment_id: str, runs: Sequence[str]) -> str:
    """Return the comparison of several runs: parallel coordinates, scatter plot, table."""
    chosen = quote(json.dumps(list(runs), separators=(",", ":")))
    return f"{base}/#/compare-runs?runs={chosen}&experiments={quote(json.dumps([experiment_id]))}"
