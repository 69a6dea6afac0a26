"""Lines of beams: generators, names, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.elements.beam_line import BeamLine


def test_straight():
    line = BeamLine.straight(2.0, 4, (0.0, 3.0, 4.0))
    assert_close(line.nodes[line.node("end")], torch.tensor([0.0, 1.2, 1.6], dtype=torch.float64))
    assert (line.node("start"), line.node("center")) == (0, 2)
    assert line.elements.tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert "center" not in BeamLine.straight(2.0, 3).node_sets
    assert len(BeamLine.straight(2.0, np.int64(3)).elements) == len(BeamLine.arc(2.0, 0.5, np.int64(3)).elements) == 3


def test_any_nodes_and_branches():
    line = BeamLine([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    assert line.elements.tolist() == [[0, 1], [1, 2]]
    assert line.node("end") == 2
    tee = BeamLine(
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]], [[0, 1], [1, 2], [1, 3]], {"tip": [3], "flange": [0, 2]}
    )
    assert tee.node("tip") == 3
    assert tee.node_set("flange") == (0, 2)
    with pytest.raises(InputError) as error:
        tee.node("tipp")
    assert (error.value.path, error.value.value) == (("node",), "tipp")
    assert "tip" in error.value.allowed
    with refused("node", "flange"):
        tee.node("flange")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"nodes": [[0, 0], [1, 0]]}, ["shape (2, 2)", "[n, 3]"]),
        ({"nodes": [[0, 0, 0], [1, math.nan, 0]]}, ["node 1", "finite"]),
        ({"nodes": [[0, 0, 0], [1, 0, 0], [1, 0, 0]]}, ["nodes 1 and 2 share one place"]),
        ({"elements": [[0, 1], [1, 2], [1, 0]]}, ["elements 0 and 2 are duplicates", "[1, 0]"]),
        ({"elements": [[0, 1], [2, 2]]}, ["element 1", "no length"]),
        ({"elements": [[0, 1], [1, 5]]}, ["element 1", "0 to 2"]),
        ({"elements": [[0, 1, 2]]}, ["shape (1, 3)", "[m, 2]"]),
        ({"elements": [[0, 1.5]]}, ["elements holds 1.5"]),
        ({"elements": [[0, 1]]}, ["2 disconnected parts", "node 2"]),
        ({"node_sets": {"tip": [3]}}, ["'tip'", "node 3", "0 to 2"]),
        ({"node_sets": {"tip": [0.7]}}, ["'tip' holds 0.7", "whole numbers"]),
        ({"node_sets": [2]}, ["node_sets of a BeamLine = [2]"]),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_lines_are_named(given: dict[str, Any], words: list[str]):
    with pytest.raises(InputError) as error:
        BeamLine(**{"nodes": [[0, 0, 0], [1, 0, 0], [2, 0, 0]], **given})
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("given", [(0.0, 4), (1.0, 0), (1.0, 2.0), (1.0, 2, (0.0, 0.0, 0.0))])
def test_bad_straight_lines_are_named(given: Any):
    with pytest.raises(InputError, match=r"^BeamLine: .* = .*: must be "):
        BeamLine.straight(*given)
