"""What `mbd.` offers: every name is there, nothing else is, and torch is imported with the first of them, not before."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType

import pytest

import torchmbd as mbd
from torchmbd.registry import public_names


def test_every_public_name_is_there():
    assert set(mbd.__all__) <= set(dir(mbd))
    assert {"animate", *(x.removeprefix("viz.") for x in public_names() if x.startswith("viz."))} <= set(dir(mbd.viz))
    everything: dict[str, object] = {}
    exec("from torchmbd import *", everything)
    assert set(mbd.__all__) <= set(everything)


def test_no_name_of_the_modules_own_is_offered():
    """As a completion would list it: imports of the module, or names of its helpers."""
    offered = {name for name in dir(mbd) if not name.startswith("_")}
    assert offered == set(mbd.__all__)
    rooms = {name: x for name in mbd.__all__ if isinstance(x := getattr(mbd, name), ModuleType)}
    for name, room in rooms.items():
        extended = {x.partition(".")[2] for x in public_names() if x.startswith(f"{name}.")}
        assert {x for x in dir(room) if not x.startswith("_")} == extended | set(room.__all__), name


def test_nothing_else_is():
    with pytest.raises(AttributeError, match="'torchmbd' has no attribute 'Path'"):
        mbd.Path  # noqa: B018


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("command", "spared"),
    [(["--help"], {"torch", "mlflow", "numpy"}), (["new", "arm.yaml"], {"torch", "mlflow"}), (["best"], {"torch"})],
    ids=lambda words: words[0] if isinstance(words, list) else "",
)
def test_the_command_line_imports_what_a_command_needs(tmp_path, command, spared):
    code = f"import sys; from torchmbd.cli import main; assert main({command!r}) == 0; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert spared & set(loaded.stdout.split()) == set()
