"""A command of torchmbd in this process, and where its time goes: `python -m experiments.benchmark.stages run FILE`.

A thread looks every 5 ms at the functions that the main thread is in; the time since the look before belongs to the stage of
the innermost function that has one, or to that of a function around it that claims everything inside (imports, compile,
pictures). A backward pass of torch has no function of ours: before the adjoint of the steps it belongs to the responses, after
it to the structure stage. The last line that is printed is a JSON object: stage -> [processor seconds, wall seconds] of the
main thread, "threads" those of all others.

Imports nothing but the standard library until the clock runs.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import defaultdict
from types import FrameType

PERIOD = 5e-3  # [s]
BACKWARD = "backward"
WHOLE = ("imports", "compile", "pictures", "tracking")  # these have everything inside
STAGES = {  # part of a path, or path:function -> stage
    "importlib._bootstrap": "imports",
    "native/library.py:_load": "compile",
    "codegen/compiler.py:load": "compile",
    "study/report/terminal.py:save_pictures": "pictures",
    "torchmbd/tracking/": "tracking",
    "study/record/journal.py": "tracking",
    "study/record/evaluations.py": "tracking",
    "integrate/adjoint.py": "adjoint",
    "integrate/phases/adjoint.py": "adjoint",
    "integrate/pullback.py": "adjoint",
    "native/backward.py": "adjoint",
    "integrate/motion.py:backward": "adjoint",
    "system/system.py:stages": "structure",
    "system/system.py:reduced": "structure",
    "torchmbd/fem/": "structure",
    "torchmbd/integrate/": "steps",
    "extensions/native/": "steps",
    "torchmbd/multibody/": "steps",
    "torch/autograd/": BACKWARD,
    "torchmbd/design/": "responses",
    "torchmbd/results/": "responses",
    "torchmbd/optimization/": "optimizer",
    "scipy/": "optimizer",
}


def stage_of(frame: FrameType | None) -> str:
    """The stage of a stack of functions, the innermost first."""
    first = "other"
    while frame is not None:
        where = f"{frame.f_code.co_filename}:{frame.f_code.co_name}"
        name = next((stage for part, stage in STAGES.items() if part in where), None)
        if name in WHOLE:
            return name  # type: ignore[return-value]
        if name is not None and first == "other":
            first = name
        frame = frame.f_back
    return first


class Clock:
    """Times of the stages of the main thread, until `stop`."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        self._main = threading.main_thread().ident or 0
        self._done = threading.Event()
        self._own = 0.0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        clock, behind = time.pthread_getcpuclockid(self._main), "responses"
        processor, wall = 0.0, time.perf_counter()
        while True:
            stopped = self._done.wait(PERIOD)
            stage = stage_of(sys._current_frames().get(self._main))
            behind = {"adjoint": "structure", BACKWARD: behind}.get(stage, "responses")
            now = time.clock_gettime(clock), time.perf_counter()
            entry = self.seconds[behind if stage == BACKWARD else stage]
            entry[0] += now[0] - processor
            entry[1] += now[1] - wall
            processor, wall = now
            self._own = time.thread_time()
            if stopped:
                return

    def stop(self) -> dict[str, list[float]]:
        """Stage -> processor and wall seconds."""
        self._done.set()
        self._thread.join()
        others = time.process_time() - self._own - sum(x[0] for x in self.seconds.values())
        return dict(self.seconds) | {"threads": [others, 0.0]}


if __name__ == "__main__":
    clock = Clock()
    from torchmbd.cli import main

    code = main(sys.argv[1:])
    print(json.dumps(clock.stop()))
    sys.exit(code)
