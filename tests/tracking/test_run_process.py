"""Runs of a process that was killed: whoever reads the store next ends them, and no others."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
from rich.console import Console

from torchmbd.study.report.compare import print_comparison
from torchmbd.study.report.listing import print_links, print_studies
from torchmbd.tracking import MlflowTracker
from torchmbd.tracking.catalog import studies
from torchmbd.tracking.run_process import has_ended, process_tag
from torchmbd.tracking.store import open_store
from torchmbd.tracking.uri import StoreURI


def test_which_processes_have_ended():
    tag = process_tag()
    machine, boot, space, number, began = tag.split(" ")
    assert not has_ended(tag)
    with subprocess.Popen([sys.executable, "-c", "pass"]) as child:
        pass
    assert has_ended(f"{machine} {boot} {space} {child.pid} {began}")
    assert has_ended(f"{machine} {boot} {space} {number} {int(began) - 1}")  # another process had the number
    assert has_ended(f"{machine} another-boot {space} {number} {began}")
    for unknown in (f"other {boot} {space} 1 1", f"{machine} {boot} pid:[1] {child.pid} 1", "", machine, "a b c d e f"):
        assert not has_ended(unknown)


def test_a_zombie_has_ended():
    process = os.fork()
    if not process:
        os._exit(0)
    time.sleep(0.1)
    began = process_tag().rpartition(" ")[2]
    assert has_ended(process_tag().replace(f" {os.getpid()} ", f" {process} ").replace(began, "1"))
    os.waitpid(process, 0)


LIFE = """
import sys, time
from torchmbd.tracking import MlflowTracker
tracker = MlflowTracker("e", sys.argv[1], sys.argv[2])
tracker.begin("study", sys.argv[2], tags={"kind": "study"})
tracker.begin("start_0", "start 0", parent="study", tags={"kind": "start"})
tracker.metrics("start_0", {"objective": 1.0}, 0)
while len(tracker.record.runs) < 2:
    time.sleep(0.01)
time.sleep(1.0)
print("here", flush=True)
time.sleep(600)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("reader", ["list", "compare", "ui"])
def test_whoever_reads_next_ends_what_was_killed(tmp_path, empty_store, reader):
    """A living study stays RUNNING beside the one that was killed."""
    uri = StoreURI(f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    lives = []
    for name in ("killed", "living"):
        lives.append(subprocess.Popen([sys.executable, "-c", LIFE, uri.whole, name], stdout=subprocess.PIPE, text=True))
        assert lives[-1].stdout is not None
        assert lives[-1].stdout.readline() == "here\n"
    try:
        lives[0].send_signal(signal.SIGKILL)
        lives[0].wait()
        silent = Console(quiet=True)
        if reader == "list":
            print_studies(uri.whole, silent)
        elif reader == "ui":
            print_links(uri, "http://host", silent)
        else:
            print_comparison("killed", "living", uri.whole, silent)
        client = open_store(uri)
        result = {run.data.tags["study_key"]: [] for run in client.search_runs(["1"])}
        for run in client.search_runs(["1"]):
            result[run.data.tags["study_key"]].append(run.info)
        assert {info.status for info in result["living"]} == {"RUNNING"}
        assert [info.status for info in result["killed"]] == ["KILLED"] * 2
        assert all(0 <= info.end_time - info.start_time < 60_000 for info in result["killed"])
        again = MlflowTracker("e", uri, "killed")  # and it goes on in its runs
        again.begin("study", "killed", tags={"kind": "study"})
        while not again.record.runs:
            time.sleep(0.01)
        assert {entry.name: entry.status for entry in studies(uri)} == {"killed": "RUNNING", "living": "RUNNING"}
        assert again.close().runs["study"] in {info.run_id for info in result["killed"]}
    finally:
        for life in lives:
            life.kill()
            life.wait()
