"""Workers: the same numbers as here, whichever worker dies."""

from __future__ import annotations

import os
import re
import signal
import socket
import ssl
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.refused import ANY, refused
from torchmbd.errors import MbdError
from torchmbd.optimization import Evaluation
from torchmbd.optimization.multistart.workers import WorkerBatch, evaluate_piece
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.file.load import load_study
from torchmbd.study.record.paths import problem_key
from torchmbd.tracking.store import open_store

SHORT = {"duration": 0.002, "steps": 8}
X = np.radians([[45.0, -45.0], [10.0, 20.0], [0.0, 5.0], [30.0, 60.0], [-80.0, 7.0]])


def same(found, expected):
    assert [e.status for e in found] == [e.status for e in expected]
    for one, other in zip(found, expected, strict=True):
        assert one.objective == pytest.approx(other.objective, rel=1e-9)
        np.testing.assert_allclose(one.constraints, other.constraints, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.objective_gradient, other.objective_gradient, rtol=1e-7, atol=1e-9)


@pytest.mark.thorough
def test_a_piece_is_what_the_problem_itself_gives(write):
    plan = load_study(write(simulate=SHORT))
    pool = study_workers(plan, problem_key(plan.simulated), 1, 2)
    same(evaluate_piece(*pool.factory, X[:2], True), plan.simulated.evaluate(X[:2], True))


@pytest.mark.thorough
def test_another_model_file_on_a_worker_is_refused(write, folder):
    plan = load_study(write(simulate=SHORT))
    pool = study_workers(plan, problem_key(plan.simulated), 1, 2)
    model = folder / "rod_model.py"
    model.write_text(model.read_text().replace("modes=4", "modes=3"))
    with pytest.raises(MbdError, match="another model file"):
        evaluate_piece(*pool.factory, X[:2], True)


def test_bad_numbers_of_workers_are_named(write):
    with refused("workers", -1):
        study_workers(load_study(write(simulate=SHORT)), "", 1, -1)


@pytest.mark.thorough
def test_only_the_study_reaches_its_workers(write):
    """Dask runs what it is sent: without the key that this study made for itself there is no answer on any port."""
    from distributed import Client, Security

    plan = load_study(write(simulate=SHORT))
    with study_workers(plan, problem_key(plan.simulated), 1, 2) as pool:
        info = pool._client.scheduler_info(n_workers=-1)
        own = {info["address"], *info["workers"], *(worker["nanny"] for worker in info["workers"].values())}
        assert {f"tls://{ip}:{port}" for ip, port in listening()} == own  # and no port for a dashboard
        assert len(own) == 5
        for address in listening():
            with socket.create_connection(address, timeout=20) as plain:
                plain.sendall(bytes(64))
                assert not answer(plain)
            anonymous = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            anonymous.check_hostname, anonymous.verify_mode = False, ssl.CERT_NONE
            with (
                socket.create_connection(address, timeout=20) as plain,
                anonymous.wrap_socket(plain) as encrypted,
                pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"),
            ):
                encrypted.recv(1)
        port = info["address"].rpartition(":")[2]
        for address, security in ((f"tcp://127.0.0.1:{port}", None), (info["address"], Security.temporary())):
            with pytest.raises(OSError, match=r"(?i)timed out|connect|certificate does not match"):
                Client(address, security=security, timeout=2)
        same(pool.evaluate(X[:1], True), plan.simulated.evaluate(X[:1], True))


def answer(connection):
    try:
        return connection.recv(1)
    except ConnectionResetError:
        return b""


def test_a_piece_that_kills_its_workers_fails_design_by_design(write):
    """Each of its designs is a failure, so that those of the next piece stay those of the next piece."""
    from distributed import KilledWorker

    class Piece(list):
        def result(self):
            if not self:
                raise KilledWorker("piece", None, 3)
            return list(self)

        def release(self):
            pass

    pool = study_workers(load_study(write(simulate=SHORT)), "", 2, 2)
    good = [Evaluation(float(k), np.zeros(2)) for k in range(4)]
    result = WorkerBatch(pool, [2, 3, 2], [Piece(good[:2]), Piece(), Piece(good[2:])]).evaluations()
    assert [e.objective for e in result if e.ok] == [0.0, 1.0, 2.0, 3.0]
    assert [e.status for e in result] == ["ok"] * 2 + ["failed: 3 workers died of it"] * 3 + ["ok"] * 2
    assert [e.constraints.shape for e in result] == [(2,)] * 7


def test_without_cryptography_there_are_no_workers(write, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.delitem(sys.modules, "torchmbd.optimization.multistart.local_cluster", raising=False)
    plan = load_study(write(simulate=SHORT))
    with (
        refused("workers", ANY, "cryptography", "pip install 'torchmbd[cluster]'"),
        study_workers(plan, "", 1, 2),
    ):
        pass


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing(write):
    plan = load_study(write(simulate={"duration": 0.01, "steps": 100}))
    with study_workers(plan, problem_key(plan.simulated), 1, 2) as pool:
        expected = plan.simulated.evaluate(X, True)
        same(pool.evaluate(X, True), expected)
        victim = next(iter(pool._client.run(os.getpid).values()))
        os.kill(victim, signal.SIGKILL)
        same(pool.evaluate(X, True), expected)


@pytest.mark.slow
def test_a_scheduler_of_the_users(write):
    from distributed import LocalCluster

    plan = load_study(write(simulate=SHORT))
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,
        study_workers(plan, problem_key(plan.simulated), 1, 0, cluster.scheduler_address) as pool,
    ):
        same(pool.evaluate(X, True), plan.simulated.evaluate(X, True))


def listening():
    """Host and port of the sockets on which this process and those below it can be reached."""
    own = psutil.Process()
    family = [own, *own.children(recursive=True)]
    return {tuple(c.laddr) for p in family for c in p.net_connections("tcp") if c.status == psutil.CONN_LISTEN}


@contextmanager
def scheduler_and_worker(port, environment):
    """As a user starts them in two terminals."""
    python = [sys.executable, "-m"]
    commands = [
        [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"],
        [*python, "distributed.cli.dask_worker", f"tcp://127.0.0.1:{port}", "--nthreads", "1", "--no-dashboard"],
    ]
    quiet = subprocess.DEVNULL
    processes = [subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet) for command in commands]
    try:
        yield processes[0]
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(timeout=60)


@pytest.mark.slow
def test_a_scheduler_that_is_killed_ends_the_study_and_another_goes_on(write, folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("TORCHMBD_STORE", str(folder / "place"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    uri = f"sqlite:///{folder / 'runs.db'}"
    file = write(
        starts={"sampler": "sobol", "count": 16, "seed": 7},
        optimizer={"name": "mmfd", "max_iterations": 12},
        tracking={"experiment": "workers", "uri": uri},
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-u", "-m", "torchmbd.cli", "run", str(file), "--scheduler", f"tcp://127.0.0.1:{port}"]
    with scheduler_and_worker(port, environment) as scheduler:
        study = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert study.stdout is not None
        assert next(line for line in study.stdout if "iteration   1" in line)
        scheduler.kill()
        _, error = study.communicate(timeout=300)
        assert study.returncode == 1
        assert "Traceback" not in error
        assert "is gone" in error
    client = open_store(uri)
    experiment = client.get_experiment_by_name("workers").experiment_id
    assert {run.info.status for run in client.search_runs([experiment])} == {"FAILED"}
    with scheduler_and_worker(port, environment):
        output = subprocess.run(command, env=environment, capture_output=True, text=True).stdout
    known, total = map(int, re.findall(r"(\d+) of (\d+) evaluations known", output)[0])
    assert 16 <= known < total
    runs = client.search_runs([experiment])
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert len(runs) == 17


@pytest.mark.slow
def test_an_interrupt_at_the_terminal_is_the_studys_to_handle(write, folder):
    """Ctrl-C reaches every process there: the study ends with what it has, its workers without a word."""
    write(starts={"sampler": "sobol", "count": 8, "seed": 7}, optimizer={"name": "mmfd", "max_iterations": 30})
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-u", "-m", "torchmbd.cli", "run", "study.yaml", "--workers", "2"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as study:
        assert study.stdout is not None
        assert next(line for line in study.stdout if "iteration   1" in line)
        os.killpg(study.pid, signal.SIGINT)
        output, error = study.communicate(timeout=120)
    assert study.returncode == 130
    assert "study: killed" in output
    assert "Traceback" not in output + error
