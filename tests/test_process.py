"""Settings of a process, seen from inside another one."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import pytest

from torchmbd import bare
from torchmbd.process import MEMORY, brief_warnings

CHURN = """
import resource, sys
from torchmbd.process import settle
if "settle" in sys.argv:
    settle()
def churn():
    for _ in range(5):
        parts = [bytearray(48_000_000) for _ in range(2)]  # as a batch does: much at once, and nothing of it kept
        del parts
churn()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
churn()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
WAYS = """
import os
from pathlib import Path
from torchmbd.process import come_forward, give_way
session = Path("/proc/self/autogroup")
for step in (give_way, come_forward):
    step()
    print(os.nice(0), session.read_text().split()[-1] if session.exists() else "-")
"""


def output(code: str, *arguments: str, environment: dict[str, str] | None = None) -> list[str]:
    """Run code without torch: the package is its folder only, as in torchmbd.bare."""
    empty = f"import sys, types; m = types.ModuleType('torchmbd'); m.__path__ = [{str(Path(bare.__file__).parent)!r}]\n"
    command = [sys.executable, "-c", empty + "sys.modules['torchmbd'] = m\n" + code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, start_new_session=True)
    return done.stdout.split()


@pytest.mark.parametrize("settled", [False, True])
def test_a_settled_process_does_without_dynamo(settled):
    """Without: torch imports it by itself, as long as it does there is something to leave out."""
    code = """
import sys, torch
from torchmbd.process import settle
if "settle" in sys.argv:
    settle()
x = torch.tensor([2.0, 3.0])
value, tangents = torch.func.vmap(lambda v: torch.func.jvp(lambda x: 2 * x * x - 1, (x,), (v,)))(torch.eye(2))
print("torch._dynamo" in sys.modules, *value[0].tolist(), *tangents.flatten().tolist())
"""
    words = output(code, "settle" if settled else "")
    assert words == [str(not settled), "7.0", "17.0", "8.0", "0.0", "0.0", "12.0"]


def test_a_bred_process_has_its_imports_and_settings_and_is_deaf():
    code = """
import multiprocessing, os, signal, sys
from torchmbd.process import breed
def child(pipe):
    pipe.send(("fractions" in sys.modules, os.environ["OMP_NUM_THREADS"], signal.getsignal(signal.SIGINT) is signal.SIG_IGN))
if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "7"
    breed("fractions")
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("forkserver").Process(target=child, args=(there,))
    process.start()
    print(*here.recv(), os.environ["OMP_NUM_THREADS"])
    process.join()
"""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "script.py"  # a child imports what its parent runs
        file.write_text(code)
        done = subprocess.run([sys.executable, file], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "1", "True", "7"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the allocator of glibc")
def test_memory_between_batches_stays():
    """A page that is handed back is faulted in again: 10 x 48 MB are 120,000 pages of 4 KiB."""
    assert int(output(CHURN, environment={k: v for k, v in os.environ.items() if k not in MEMORY})[0]) > 30_000
    assert int(output(CHURN, "settle")[0]) < 1_000
    assert int(output(CHURN, environment=MEMORY)[0]) < 1_000


def test_helpers_give_way_until_they_are_waited_for():
    nice, session, nice_then, session_then = output(WAYS)
    assert nice == nice_then == str(os.nice(0) + 5)
    assert (session, session_then) in (("5", "0"), ("-", "-"))


def test_a_warning_is_said_once_without_the_code_that_gave_it(capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        brief_warnings()
        for text in ("too few: 1037 steps", "too few: 1.3e+03 steps", "something else"):
            warnings.warn(text, stacklevel=1)
    assert capsys.readouterr().err.splitlines() == ["warning: too few: 1037 steps", "warning: something else"]


def test_what_is_exempt_is_not_searched_again():
    code = "import gc, torch; from torchmbd.process import exempt; exempt(); exempt(); print(gc.get_freeze_count())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(found.stdout) > 50_000
