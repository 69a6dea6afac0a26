"""Jobs of a SLURM cluster as workers: `torchmbd run FILE --scheduler docs/how-to/cluster/slurm.yaml --workers 64`.

    partition, account, time   of every job, as sbatch takes them; time: "04:00:00"
    workers_per_job            processes of one job, one core each
    memory_per_worker          "2 GB"
    interface                  network between the jobs and the process that runs the study: ib0, eth0; all listen there
                               only. Default: the network of this machine's way out
    setup                      shell lines before the workers start: module load gcc
    directives                 more options of sbatch: --constraint=avx512

dask-jobqueue submits the jobs; the study begins with the first, and uses the jobs that are running. Workers and study
authenticate by TLS certificates that are made for this study, and lie in its folder, readable by the user alone.
Assumed: the jobs see the working directory at the same path.
Checked in tests/study/test_cluster.py: what is submitted, and a study on jobs that a stand-in for sbatch starts.
"""

from __future__ import annotations

import math
import shutil
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PositiveInt

from torchmbd.errors import InputError, must_be_one, not_installed
from torchmbd.process import worker_threads
from torchmbd.study.file.faults import Fault, StudyError, located
from torchmbd.study.file.schema import Section
from torchmbd.study.file.validation import validate
from torchmbd.study.file.yaml_file import read_yaml
from torchmbd.study.record.paths import make_studies_folder

Word = Annotated[str, Field(pattern=r"^[\w.:/=+-]+$")]
_LOOPBACK = "127.0.0.1:0"  # at any free port
Line = Annotated[str, Field(pattern=r"^[^\n]+$")]


class Slurm(Section):
    """A cluster file."""

    partition: Word | None = None
    account: Word | None = None
    time: Annotated[str, Field(pattern=r"^(\d+-)?\d{1,2}:\d{2}:\d{2}$")]
    workers_per_job: PositiveInt = 1
    memory_per_worker: Annotated[str, Field(pattern=r"^\d+(\.\d+)? ?[KMGT]i?B$")] = "2 GB"
    interface: Word | None = None
    setup: list[Line] = Field(default_factory=list)
    directives: list[Line] = Field(default_factory=list)

    def start(self, workers: int) -> Any:
        """Submit jobs for so many workers and return the cluster that they join."""
        try:
            import cryptography  # noqa: F401  pyright: ignore[reportMissingImports]  what `security=True` needs
            from dask.utils import format_bytes, parse_bytes  # pyright: ignore[reportMissingImports]
            from dask_jobqueue.slurm import SLURMCluster  # pyright: ignore[reportMissingImports]
        except ModuleNotFoundError as error:
            raise _missing(error) from None
        n, folder = self.workers_per_job, make_studies_folder()
        cluster = SLURMCluster(
            queue=self.partition,
            account=self.account,
            walltime=self.time,
            cores=n,
            processes=n,
            memory=format_bytes(n * parse_bytes(self.memory_per_worker)),
            interface=self.interface,
            job_name="torchmbd",
            job_extra_directives=self.directives,
            job_script_prologue=[
                *(f"export {name}={value}" for name, value in worker_threads().items()),
                *self.setup,
            ],
            log_directory=str(folder / "jobs"),
            local_directory="${TMPDIR:-/tmp}",
            shared_temp_directory=str(folder),
            security=True,
            scheduler_options={"dashboard_address": _LOOPBACK},  # pages of plain HTTP, not reachable by others
            worker_extra_args=["--dashboard-address", _LOOPBACK],
            python=sys.executable,
        )
        try:
            _require_accepted(cluster.job_script())
        except InputError:
            cluster.close()
            raise
        cluster.scale(jobs=math.ceil(workers / n))
        return cluster


def load_cluster(file: str | Path) -> Slurm:
    """Read a cluster file; StudyError with all its faults."""
    document = read_yaml(file)
    sections, faults = validate(document.data, Slurm)
    faults += _interface_faults(sections.get("interface"))
    if faults:
        raise StudyError(document.source, located(faults, document.lines))
    return Slurm.model_validate(document.data)


def _interface_faults(name: str | None) -> list[Fault]:
    """Return a fault if this machine, where the study runs, has no address in the network `name`."""
    if name is None:
        return []
    try:
        from psutil import net_if_addrs  # as Dask finds the address
    except ModuleNotFoundError as error:
        raise _missing(error) from None
    names = [name for name, addresses in net_if_addrs().items() if any(a.family == socket.AF_INET for a in addresses)]
    text = f"= {name!r}: this machine has no address in such a network: {must_be_one(name, names)}"
    return [] if name in names else [Fault(("interface",), text)]


def _require_accepted(script: str) -> None:
    """InputError with the words of sbatch if it refuses a job: a partition, an account or a size that the cluster has not."""
    if sbatch := shutil.which("sbatch"):  # without it, dask_evaluator.py has refused
        with tempfile.NamedTemporaryFile("w", suffix=".sh") as file:
            file.write(script)
            file.flush()
            answer = subprocess.run([sbatch, "--test-only", file.name], capture_output=True, text=True)
        if answer.returncode:
            said = " ".join(answer.stderr.replace("sbatch: error: ", "").split())
            raise InputError(
                "scheduler",
                allowed="must get a partition, an account and sizes that the cluster has",
                noun="sbatch",
                state=f"refuses the jobs of the cluster file: {said}",
            )


def _missing(error: ModuleNotFoundError) -> InputError:
    return not_installed(
        "scheduler", "", "the client of SLURM jobs", str(error.name), "pip install 'torchmbd[slurm]', or --workers"
    )
