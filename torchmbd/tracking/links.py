"""Links to views of MLflow's UI.

By default the UI (3.17) opens an experiment in its mode for language models, folds the children of a run and shows no metric
in their table. A link avoids this by search facets, or by the key of a shared view, which a tag of the experiment holds
(facets and columns; the UI ignores the key if the link has facets as well).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from urllib.parse import quote

DEFAULT_BASE = "http://127.0.0.1:5000"
VIEW_TAG = "mlflow.sharedViewState."  # + run id of the parent: tag of the experiment that holds a view of its children
_MODE = "workflowType=machine_learning"


def experiment_link(base: str, experiment_id: str) -> str:
    """Return the link of the table of all runs, ordered by their objective."""
    order = f"orderByKey={quote('metrics.`objective`')}&orderByAsc=true"
    return f"{base}/#/experiments/{experiment_id}/runs?{_MODE}&{order}"


def view_link(base: str, experiment_id: str, parent_run: str, charts: bool = False) -> str:
    """Return the link of the children of a study, as `MlflowTracker.view` has arranged them: a table, or charts."""
    mode = "&compareRunsMode=CHART" if charts else ""
    return f"{base}/#/experiments/{experiment_id}/runs?{_MODE}&viewStateShareKey={parent_run}{mode}"


def run_link(base: str, experiment_id: str, run: str, page: str = "") -> str:
    """Return the link of a run; `page`: "model-metrics" for charts, "artifacts" for files, "artifacts/motion.html" for one."""
    return f"{base}/#/experiments/{experiment_id}/runs/{run}{'/' if page else ''}{page}?{_MODE}"


def compare_link(base: str, experiment_id: str, runs: Sequence[str]) -> str:
    """Return the link of the comparison of several runs: parallel coordinates, scatter plot, table."""
    chosen = quote(json.dumps(list(runs), separators=(",", ":")))
    return f"{base}/#/compare-runs?runs={chosen}&experiments={quote(json.dumps([experiment_id]))}&{_MODE}"
