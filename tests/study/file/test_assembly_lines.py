"""What `torchmbd check` says of joints that are open where the model puts its bodies."""

from __future__ import annotations

import io
from types import SimpleNamespace

from rich.console import Console

from tests.multibody.start.test_closing import crane
from tests.multibody.start.test_initial import four_bar
from tests.refused import warned
from torchmbd.study.estimate import _print_assembly


def said(system: object) -> str:
    text = io.StringIO()
    _print_assembly(SimpleNamespace(system=system), Console(file=text, width=200))  # type: ignore[arg-type]
    return text.getvalue()


def test_joints_bodies_and_distances_are_listed():
    with warned("open"):
        text = said(crane(gap=0.2))
    assert "warning: open where the bodies were put: joint 'grip' by 0.2 m" in text
    assert "warning: to close the joints the start moves 'tool' by 0.2 m" in text


def test_over_constraint_is_listed_and_nothing_else_is():
    assert said(crane()) == ""
    assert said(four_bar()).startswith("over-constraint: ")
