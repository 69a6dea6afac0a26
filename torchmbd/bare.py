"""Processes of torchmbd's own that do without torch, which takes 3 seconds and 250 MB to import.

A module is run in another process with the packages above it empty: their `__init__`, which would import everything,
is not executed. Used by torchmbd.tracking.process and torchmbd.viz.studio.
Checked in tests/viz/test_studio.py, tests/tracking/test_spool.py.
"""

from __future__ import annotations

import sys
from pathlib import Path

_BOOT = """
import importlib, os, pathlib, sys, types
folder, name, *arguments = sys.argv[1:]
parts = name.split(".")
for k in range(1, len(parts)):
    package = types.ModuleType(".".join(parts[:k]))
    package.__path__ = [str(pathlib.Path(folder, *parts[1:k]))]
    sys.modules[package.__name__] = package
code = importlib.import_module(name).main(*arguments)
sys.stdout.flush()
os._exit(code)  # taking MLflow's modules down takes a second, which somebody waits for
"""


def command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs `main(*arguments)` of a module: `torchmbd.tracking.writer`."""
    return [sys.executable, "-P", "-c", _BOOT, str(Path(__file__).parent), module, *arguments]
