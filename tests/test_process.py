"""Settings of a process."""

from __future__ import annotations

import gc
import os
import platform
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import torchmbd as mbd
from tests.refused import refused
from torchmbd import process
from torchmbd.process import ONE_THREAD, _least_quota, brief_warnings, cores, imports, thread_count, worker_threads


@pytest.mark.thorough
def test_a_process_has_one_thread_unless_the_environment_says_otherwise():
    code = "import torch; from torchmbd.process import use_one_thread; use_one_thread(); print(torch.get_num_threads())"
    for given, expected in (({}, "1"), ({"OMP_NUM_THREADS": "2"}, "2")):
        environment = {key: value for key, value in os.environ.items() if key not in ONE_THREAD} | given
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split() == [expected]


@pytest.mark.thorough
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no such setting")
def test_freed_memory_is_used_again_unless_the_environment_says_otherwise():
    code = """
import resource, sys, torch
from torchmbd.process import keep_freed_memory
kept = keep_freed_memory()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(5_000_000, dtype=torch.float64)  # 40 MB, 10,000 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
warm_up = [faults() for _ in range(20)]  # the heap grows to what its rests need
print(kept, faults())
"""
    for given, expected in (({}, True), ({"MALLOC_TRIM_THRESHOLD_": "131072"}, False)):
        environment = os.environ | given
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        kept, faults = done.stdout.split()
        assert kept == str(expected)
        assert (int(faults) < 100) is expected


def test_a_search_has_one_thread_of_blas_and_restores_their_number(monkeypatch):
    """Whose threads wait busily on the cores of compiled code."""
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)

    class Bowl:
        start, lower, upper, names = np.ones(1), -np.ones(1), np.ones(1), ["x"]

        def evaluate(self, X, gradients):
            seen.update(threads())
            return [mbd.optimization.Evaluation(float(x @ x), np.zeros(0), 2 * x, np.zeros((0, 1))) for x in X]

    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, "blas"):
        for search in (mbd.optimization.optimize, mbd.optimization.multistart):
            seen = set()
            search(Bowl())
            assert seen == {1}
            assert threads() == {2}
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
        seen = set()
        mbd.optimization.optimize(Bowl())
        assert seen == {2}


def test_the_number_of_threads_is_that_of_the_call_the_environment_or_the_cores(monkeypatch):
    monkeypatch.delenv("TORCHMBD_THREADS", raising=False)
    assert thread_count() == cores() <= (os.cpu_count() or 1)
    assert worker_threads()["TORCHMBD_THREADS"] == "1"
    monkeypatch.setenv("TORCHMBD_THREADS", "5")
    assert thread_count() == 5
    assert worker_threads()["TORCHMBD_THREADS"] == "5"
    with mbd.threads(2):
        assert thread_count() == 2
        with mbd.threads(3):
            assert thread_count() == 3
        assert thread_count() == 2
    assert thread_count() == 5
    with mbd.threads(7):
        mbd.threads(4)  # a statement alone holds from now on, to the end of the block around it
        assert thread_count() == 4
    assert thread_count() == 5


@pytest.mark.parametrize("count", [0, -1, 1.5, "two", True, None])
def test_other_numbers_of_threads_are_refused(count):
    with refused("threads", count, "mbd.threads"):
        mbd.threads(count)


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "two", "", "\u0662"])
def test_other_numbers_in_the_environment_are_refused_by_name(text, monkeypatch):
    monkeypatch.setenv("TORCHMBD_THREADS", text)
    with refused("TORCHMBD_THREADS"):
        thread_count()


QUOTAS = {  # lines of /proc/self/cgroup, files, and the cores that they allow
    "version 2": ("0::/a/b", {"a/b/cpu.max": "max 100000", "a/cpu.max": "250000 100000"}, 2.5),
    "version 2 in a container": ("0::/", {"cpu.max": "50000 100000"}, 0.5),
    "version 1": (
        "4:memory:/m\n1:cpuacct,cpu:/a",
        {"cpu/a/cpu.cfs_quota_us": "300000", "cpu/a/cpu.cfs_period_us": "100000"},
        3.0,
    ),
    "no quota": (
        "1:cpu:/\n0::/",
        {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000", "cpu.max": "max 100000"},
        float("inf"),
    ),
    "a group outside of the container": ("1:cpu:/docker/1", {}, float("inf")),
}


@pytest.mark.parametrize("name", QUOTAS)
def test_quotas_of_control_groups(name: str, tmp_path: Path):
    groups, files, quota = QUOTAS[name]
    (tmp_path / "groups").write_text(groups)
    for path, text in files.items():
        file = tmp_path / "fs" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")
    assert _least_quota(tmp_path / "groups", tmp_path / "fs") == quota
    assert _least_quota(tmp_path / "none", tmp_path / "fs") == float("inf")


GRADIENT = """
import sys
import torchmbd as mbd
energy = mbd.StrainEnergy("arm")
options = {"steps": 4, "gradients": "reverse"}  # torch's forward mode imports torch._dynamo for tangents that are zero
problem = mbd.Problem(mbd.examples.arm(), 0.01, mbd.Integral(energy), [mbd.Max(energy) <= 1.0], **options)
[found] = problem.evaluate(problem.start[None], True)
assert found.objective_gradient is not None, found.status
print([name for name in ("torch._dynamo", "torch._inductor", "mlflow", "matplotlib") if name in sys.modules])
"""


@pytest.mark.thorough
def test_a_gradient_imports_neither_a_compiler_nor_pictures_nor_tracking():
    environment = os.environ | {"TORCHMBD_COMPILE": "0"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", GRADIENT], env=environment, capture_output=True, text=True
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_imports_collect_no_garbage():
    assert gc.isenabled()
    with imports():
        assert not gc.isenabled()
        with imports():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_a_warning_is_said_once_without_the_code_that_gave_it(capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        brief_warnings()
        for text in ("too few: 1037 steps", "too few: 1.3e+03 steps", "something else"):
            warnings.warn(text, stacklevel=1)
    assert capsys.readouterr().err.splitlines() == ["warning: too few: 1037 steps", "warning: something else"]


def test_available_memory_is_that_of_this_machine():
    import psutil

    total = psutil.virtual_memory().total
    assert process.installed_memory() <= 1.01 * total
    assert 0.2 * psutil.virtual_memory().available <= process.available_memory() <= process.installed_memory()


def test_a_kernel_that_does_not_say_what_is_available_has_what_is_installed(monkeypatch):
    """/proc/meminfo of WSL 1."""
    read = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path: "MemFree: 1 kB\n" if path.name == "meminfo" else read(path))
    assert process.available_memory() == process.installed_memory()


@pytest.mark.parametrize(
    ("group", "file", "folder"),
    [
        ("0::/system.slice/slurmstepd.scope/job_7/step_0", "memory.max", "system.slice/slurmstepd.scope/job_7"),
        ("4:cpuset,memory:/slurm/job_7/step_0", "memory.limit_in_bytes", "memory/slurm/job_7"),
    ],
)
def test_the_limit_of_a_job_is_that_of_its_control_group(tmp_path, monkeypatch, group, file, folder):
    """SLURM limits a job by a group of its own, below the root; its steps have no limit of their own."""
    (tmp_path / folder / "step_0").mkdir(parents=True)
    (tmp_path / folder / file).write_text("123456\n")
    (tmp_path / folder / "step_0" / file).write_text("max\n")
    (tmp_path / "groups").write_text(f"3:cpuacct:/elsewhere\n{group}\n")
    monkeypatch.setattr(process, "_CONTROL_GROUPS", tmp_path)
    monkeypatch.setattr(process, "_OF_PROCESS", tmp_path / "groups")
    assert process.installed_memory() == 123456.0
