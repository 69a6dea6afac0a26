"""Links that open MLflow's UI in the view that is wanted.

Left to itself the UI (3.17) opens an experiment in its mode for language models, folds the children of a run and shows no
metric in their table. Two ways around, both read off the UI itself: search facets in the link, or the key of a shared
view that an experiment's tag holds (facets and columns; the UI ignores the key if the link has facets as well).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from urllib.parse import quote

DEFAULT_BASE = "http://127.0.0.1:5000"
VIEW_TAG = "mlflow.sharedViewState."  # + run id of the parent: tag of the experiment that holds a view of its children
_MODE = "workflowType=machine_learning"


def experiment_link(base: str, experiment_id: str) -> str:
    """Return the table of all runs ordered by their objective."""
    order = f"orderByKey={quote('metrics.`objective`')}&orderByAsc=true"
    return f"{base}/#/experiments/{experiment_id}/runs?{_MODE}&{order}"


def view_link(base: str, experiment_id: str, parent_run: str, charts: bool = False) -> str:
    """Return the children of a study as its tracker's `view` arranged them: a table, or charts over the iterations."""
    mode = "&compareRunsMode=CHART" if charts else ""
    return f"{base}/#/experiments/{experiment_id}/runs?{_MODE}&viewStateShareKey={parent_run}{mode}"


def run_link(base: str, experiment_id: str, run: str, page: str = "") -> str:
    """Return one run; `page`: "model-metrics" its charts, "artifacts" its files, "artifacts/motion.html" one of them."""
    return f"{base}/#/experiments/{experiment_id}/runs/{run}{'/' if page else ''}{page}?{_MODE}"


def compare_link(base: str, experiment_id: str, runs: Sequence[str]) -> str:
    """Return the comparison of several runs: parallel coordinates, scatter plot, table."""
    chosen = quote(json.dumps(list(runs), separators=(",", ":")))
    return f"{base}/#/compare-runs?runs={chosen}&experiments={quote(json.dumps([experiment_id]))}&{_MODE}"
