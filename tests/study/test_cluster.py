"""Cluster files: what is submitted to SLURM, what is refused, and a study on jobs.

Where slurm-wlm and munge are installed, the jobs are those of a SLURM that the script of docs/how-to/clusters.md starts;
elsewhere a stand-in for sbatch starts them.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import stat
import subprocess
import tempfile
import time
from pathlib import Path

import pytest
import yaml

from tests.refused import refused
from torchmbd import cli
from torchmbd.optimization.multistart.workers import LANES
from torchmbd.study.cluster import load_cluster
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study
from torchmbd.study.record.unfinished import StudyState, unsent
from torchmbd.study.run import UNVERIFIED

SHIPPED = Path(__file__).parents[2] / "docs/how-to/cluster"
SMALL = {"time": "00:10:00", "workers_per_job": 2, "memory_per_worker": "1 GB", "interface": "lo"}


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A place for studies, and commands that submit a job by starting it here, and cancel it by killing it."""
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "place"))
    submit = f'[ "$1" = --test-only ] && exit; cp "$1" {tmp_path}/job.$$.sh\n'
    submit += f"setsid bash {tmp_path}/job.$$.sh > {tmp_path}/job.log 2>&1 &\n"
    commands = {
        "sbatch": submit + 'echo "Submitted batch job $!"',
        "scancel": f'echo "$1" >> {tmp_path}/cancelled; kill -- -"$1"',
    }
    (tmp_path / "bin").mkdir()
    for name, text in commands.items():
        file = tmp_path / "bin" / name
        file.write_text(f"#!/bin/bash\n{text}\n")
        file.chmod(file.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    return tmp_path


@pytest.fixture
def one_machine(tmp_path, monkeypatch):
    """SLURM on this machine, as docs/how-to/clusters.md says."""
    if shutil.which("slurmctld", path="/usr/sbin:/usr/local/sbin") is None:
        pytest.skip("slurm-wlm and munge are not installed")
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "place"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        monkeypatch.setenv("PORT", str(probe.getsockname()[1]))
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # short: the path of a socket has 107 characters at most
    script = ["sh", str(SHIPPED / "one_machine.sh")]
    try:
        subprocess.run([*script, "start", str(folder)], check=True)
        monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        for _ in range(100):
            if "idle" in subprocess.run(["sinfo", "--noheader"], capture_output=True, text=True).stdout:
                break
            time.sleep(0.1)
        yield
    finally:
        subprocess.run([*script, "stop", str(folder)], check=True)
        time.sleep(1.0)
        shutil.rmtree(folder, ignore_errors=True)


def write(folder, **keys):
    file = folder / "slurm.yaml"
    file.write_text(yaml.safe_dump(SMALL | keys))
    return file


@pytest.mark.parametrize("file", sorted(SHIPPED.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_shipped_files_are_valid(file):
    assert load_cluster(file).model_fields_set == set(yaml.safe_load(file.read_text()))


def test_what_is_submitted(slurm, monkeypatch):
    cluster_file = load_cluster(
        write(slurm, partition="cpu", account="me", setup=["module load gcc"], directives=["--constraint=avx512"])
    )
    monkeypatch.setattr("dask_jobqueue.core.JobQueueCluster.scale", lambda self, jobs: setattr(self, "asked", jobs))
    cluster = cluster_file.start(5)
    try:
        script = cluster.job_script()
        assert cluster.asked == 3  # jobs of two workers
    finally:
        cluster.close()
    for line in ("-p cpu", "-A me", "--cpus-per-task=2", "--mem=2G", "-t 00:10:00", "--constraint=avx512"):
        assert f"#SBATCH {line}" in script
    lines = script.splitlines()
    command = lines.index(next(line for line in lines if "dask_worker" in line))
    assert lines.index("export OMP_NUM_THREADS=1") < lines.index("module load gcc") < command
    assert "--nworkers 2" in lines[command]
    assert "--nthreads 1" in lines[command]
    assert "--protocol tls://" in lines[command]
    assert "--interface lo" in lines[command]
    assert "--dashboard-address 127.0.0.1:0" in lines[command]  # plain HTTP, which others could read
    [key] = re.findall(r"--tls-key (\S+)", lines[command])
    assert Path(key).parent == slurm / "place"
    assert stat.S_IMODE(Path(key).stat().st_mode) == 0o600  # the user's own


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"time": "4 hours"}, "line 3: time = '4 hours'"),
        ({"partion": "cpu"}, "Try: 'partition'"),
        ({"workers_per_job": 0}, "workers_per_job = 0: must be greater than 0"),
        ({"account": "me\n#SBATCH --uid=0"}, "account = "),
        ({"setup": ["true\nrm -rf ."]}, "setup.0 = "),
        ({"memory_per_worker": "lots"}, "memory_per_worker = 'lots'"),
        ({"interface": "ib7"}, "line 1: interface = 'ib7': this machine has no address in such a network: must be "),
        ({"interface": "l0"}, "Try: 'lo'"),
    ],
)
def test_what_is_wrong_is_named(slurm, keys, message):
    with pytest.raises(StudyError) as caught:
        load_cluster(write(slurm, **keys))
    assert message in str(caught.value)


@pytest.mark.thorough
def test_workers_must_be_asked_for(slurm, folder, monkeypatch, capsys):
    (folder / "study.yaml").write_text(Path(__file__).with_name("study.yaml").read_text())
    monkeypatch.chdir(folder)
    plan = load_study("study.yaml")
    with refused("workers", 0):
        study_workers(plan, "", 1, 0, str(write(slurm)))
    assert study_workers(plan, "", 1, 3, str(write(slurm))).lanes == 3 * LANES
    assert cli.main(["run", "study.yaml", "--scheduler", str(write(slurm, time=3))]) == 2
    assert "time = 3" in capsys.readouterr().err
    assert not (folder / "mlflow.db").exists()


@pytest.mark.thorough
def test_a_cluster_that_cannot_be_used_ends_a_study_at_once(slurm, folder, monkeypatch, capsys):
    """With exit code 2, what is wrong, and nothing left behind that would wait to be sent."""
    (folder / "study.yaml").write_text(Path(__file__).with_name("study.yaml").read_text())
    monkeypatch.chdir(folder)
    refusal = "sbatch: error: invalid partition specified: nope"
    for sbatch, keys, message in (
        (
            f"echo '{refusal}' >&2; exit 1",
            {},
            "sbatch refuses the jobs of the cluster file: invalid partition specified: nope",
        ),
        ("exit", {"interface": "ib7"}, "interface = 'ib7'"),
    ):
        (slurm / "bin" / "sbatch").write_text(f"#!/bin/bash\n{sbatch}\n")
        assert cli.main(["run", "study.yaml", "--scheduler", str(write(slurm, **keys)), "--workers", "2"]) == 2
        assert message in capsys.readouterr().err
    monkeypatch.setenv("PATH", str(slurm))
    assert cli.main(["run", "study.yaml", "--scheduler", str(write(slurm)), "--workers", "2"]) == 2
    assert "this machine has no sbatch" in capsys.readouterr().err
    assert not list(unsent())


def test_the_command_that_goes_on_keeps_the_workers(folder, monkeypatch):
    monkeypatch.chdir(folder)
    study = StudyState(
        folder / ".torchmbd" / "key", "arm", "../my arm.yaml", ["starts.count=3"], "arms", "sqlite:///x.db", "id"
    )
    assert study.command() == "torchmbd run 'my arm.yaml' starts.count=3"
    assert study.command(workers=1, scheduler=None, fresh=False) == study.command()
    long = study.command(workers=64, scheduler="my slurm.yaml", fresh=True)
    assert long == f"{study.command()} --workers 64 --scheduler 'my slurm.yaml' --fresh"
    assert study.command(workers=0) == f"{study.command()} --workers 0"
    study.file = None
    assert study.command(workers=4, fresh=True) == "run(workers=4, fresh=True) of mbd.Study(..., name='arm'), in Python"


@pytest.mark.slow
def test_a_study_runs_on_slurm(one_machine, folder, monkeypatch, capfd):
    """The shipped file as it is; Ctrl-C says how to go on; what SLURM does not have is refused in its words."""
    (folder / "study.yaml").write_text(Path(__file__).with_name("study.yaml").read_text())
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    command = ["run", "study.yaml", "simulate.duration=0.002", "simulate.steps=8", "starts.count=6"]
    jobs = ["--scheduler", str(SHIPPED / "slurm.yaml"), "--workers", "2"]
    nowhere = write(folder, partition="nowhere")
    assert cli.main([*command, "--scheduler", str(nowhere), "--workers", "2"]) == 2
    assert "invalid partition specified: nowhere" in capfd.readouterr().err
    with monkeypatch.context() as change:
        change.setattr("torchmbd.study.run.save_pictures", _interrupt)
        assert cli.main([*command, *jobs]) == 130
    assert f"to go on with it: torchmbd {' '.join([*command, '--workers', '2', *jobs[:2]])}" in capfd.readouterr().out
    assert cli.main([*command, *jobs]) == UNVERIFIED  # eight steps do not resolve the rod
    assert "6 starts" in capfd.readouterr().out
    assert not subprocess.run(["squeue", "--noheader", "--states=PENDING,RUNNING"], capture_output=True).stdout


def _interrupt(*_):
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_study_runs_on_jobs(slurm, folder, monkeypatch, capsys):
    (folder / "study.yaml").write_text(Path(__file__).with_name("study.yaml").read_text())
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    command = ["run", "study.yaml", "simulate.duration=0.002", "simulate.steps=8", "starts.count=6"]
    code = cli.main([*command, "--scheduler", str(write(slurm)), "--workers", "2"])
    assert code == UNVERIFIED  # eight steps do not resolve the rod
    output = capsys.readouterr().out
    assert "6 starts" in output
    assert "evaluations of this problem are on disk" not in output
    [job] = re.findall(r"\d+", (slurm / "cancelled").read_text())  # nothing is left in the queue
    for _ in range(300):
        if _over(job):
            break
        time.sleep(0.1)
    assert _over(job)
    assert cli.main(command) == UNVERIFIED  # here it is the same study, which is finished
    assert "nothing is run again" in capsys.readouterr().out


def _over(process: str) -> bool:
    status = Path(f"/proc/{process}/stat")
    return not status.exists() or status.read_text().rpartition(") ")[2].startswith("Z")
