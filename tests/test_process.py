"""Settings of a process."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import warnings

import pytest

from torchmbd.process import ONE_THREAD, brief_warnings, imports


@pytest.mark.thorough
def test_a_process_has_one_thread_unless_the_environment_says_otherwise():
    code = "import torch; from torchmbd.process import use_one_thread; use_one_thread(); print(torch.get_num_threads())"
    for given, expected in (({}, "1"), ({"OMP_NUM_THREADS": "2"}, "2")):
        environment = {key: value for key, value in os.environ.items() if key not in ONE_THREAD} | given
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split() == [expected]


GRADIENT = """
import sys
import torchmbd as mbd
energy = mbd.StrainEnergy("arm")
problem = mbd.Problem(mbd.examples.arm(), 0.01, mbd.Integral(energy), [mbd.Max(energy) <= 1.0], steps=4)
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
