"""Forward mode for one thread at a time, and nothing in the package that goes around it."""

from __future__ import annotations

import re
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from torch import Tensor

import torchmbd
from torchmbd.math.forward_mode import jacfwd, jvp
from torchmbd.math.module_call import exclusive


def test_threads_have_the_derivatives_of_one_thread():
    begun = threading.Barrier(2, timeout=0.05)

    def slow_cube(x: Tensor) -> Tensor:
        try:
            begun.wait()  # two threads inside would meet here
        except threading.BrokenBarrierError:
            begun.reset()
        return x**3

    x = torch.tensor(2.0, dtype=torch.float64)

    def slopes(_: int) -> tuple[float, float]:
        return float(jvp(slow_cube, (x,), (torch.ones_like(x),))[1]), float(jacfwd(slow_cube)(x))

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(slopes, range(2))) == [(12.0, 12.0)] * 2


def test_derivatives_of_exclusive_functions_wait_for_no_thread_that_waits_for_them():
    x, has_begun, slopes = torch.tensor(2.0, dtype=torch.float64), threading.Event(), []

    @exclusive
    def tripled(y: Tensor) -> Tensor:
        return 3.0 * y

    def slope() -> None:
        slopes.append(float(jvp(tripled, (x,), (torch.ones_like(x),))[1]))

    @exclusive
    def slope_inside() -> None:
        has_begun.set()
        threading.Event().wait(0.05)  # in which the other thread comes as far as it can
        slope()

    def slope_outside() -> None:
        has_begun.wait()
        slope()

    threads = [threading.Thread(target=run, daemon=True) for run in (slope_inside, slope_outside)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10.0)
    assert slopes == [3.0, 3.0]


def test_the_package_calls_forward_mode_by_this_module_alone():
    folder = Path(torchmbd.__file__).parent
    direct = re.compile(r"torch\.func\.(jvp|jacfwd|hessian|linearize)\(|from torch\.func import .*(jvp|jacfwd|hessian)")
    names = {str(path.relative_to(folder)) for path in folder.rglob("*.py") if direct.search(path.read_text())}
    assert names == {"math/forward_mode.py"}
