"""A real MLflow server that goes away in the middle of a study and comes back."""

from __future__ import annotations

import shutil
import socket
import time

import pytest

from torchmbd.tracking import MlflowTracker
from torchmbd.tracking.server import serving
from torchmbd.tracking.store import open_store


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow
def test_a_server_that_goes_away_costs_nothing(tmp_path, empty_store, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "60")
    port = free_port()
    store, base = f"sqlite:///{shutil.copy(empty_store, tmp_path)}", f"http://127.0.0.1:{port}"
    with serving(store, port=port):
        tracker = MlflowTracker("outage", base)
        tracker.begin("study", "s")
        tracker.metrics("study", {"objective": 3.0}, 0)
        while not tracker.record.runs:
            time.sleep(0.1)
    began = time.monotonic()
    for step in range(1, 50):
        tracker.metrics("study", {"objective": 3.0 / step}, step)
    tracker.begin("start_0", "start 0", parent="study")
    tracker.end("start_0", "FINISHED")
    tracker.end("study", "FINISHED")
    assert time.monotonic() - began < 1.0  # the study does not wait
    while tracker.trouble is None:
        time.sleep(0.1)
    assert base in tracker.trouble
    with serving(store, port=port):
        record = tracker.close()
    client = open_store(store)
    history = client.get_metric_history(record.runs["study"], "objective")
    assert sorted(point.step for point in history) == list(range(50))
    assert {client.get_run(run).info.status for run in record.runs.values()} == {"FINISHED"}
    assert len(client.search_runs([record.experiment_id])) == 2
