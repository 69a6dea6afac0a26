"""What a section's mesh refuses, by element; and user meshes that it takes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from tests.fem.sections.section_cases import ISOTROPIC
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.sections import Section, SectionMesh

SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def mesh(**given: Any) -> SectionMesh:
    return SectionMesh(**({"nodes": SQUARE, "elements": ((0, 1, 2), (0, 2, 3))} | given))


def test_lists_arrays_and_mixed_kinds_are_taken():
    for elements in ([[0, 1, 2], [0, 2, 3]], np.array([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0, 1, 2], [0, 2, 3]])):
        assert [tuple(block.shape) for block in mesh(elements=elements).elements] == [(2, 3)]
    nodes = [*SQUARE, [2.0, 0.5]]
    assert [tuple(b.shape) for b in mesh(nodes=nodes, elements=[[[0, 1, 2, 3]], [[1, 4, 2]]]).elements] == [
        (1, 4),
        (1, 3),
    ]
    assert mesh(layer=[0, 2]).layers == 3


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"nodes": [[0.0, 0.0, 0.0]] * 4}, ["nodes has shape (4, 3)", "[n, 2]"]),
        ({"nodes": [*SQUARE[:3], [0.0, math.nan]]}, ["node 3", "nan", "finite"]),
        ({"nodes": [*SQUARE[:3], [0.0, 0.0]]}, ["nodes 0 and 3 share one place"]),
        ({"nodes": [*SQUARE, [5.0, 5.0]]}, ["1 nodes belong to no element: [4]"]),
        ({"elements": [[0, 1, 2], [0, 2, 7]]}, ["element 1", "[0, 2, 7]", "0 to 3"]),
        ({"elements": [[0, 1, 2], [0, 3, 2]]}, ["element 1", "[0, 3, 2]", "inverted or collapsed"]),
        ({"elements": [[0, 1, 3, 2]]}, ["element 0", "inverted or collapsed"]),
        ({"elements": [[0, 1, 2, 3, 0]]}, ["shape (1, 5)", "3, 4, 6, 8"]),
        ({"nodes": "square"}, ["nodes = 'square'"]),
        ({"elements": [[0, 1, 2], [0, 2]]}, ["elements", "whole numbers"]),
        ({"elements": [[0, 1, 2.5]]}, ["elements holds 2.5"]),
        ({"layer": [0, -1]}, ["layer -1"]),
        ({"layer": [0, 0, 1]}, ["layer has shape (3,)", "one for each element"]),
        (
            {"nodes": [*SQUARE, [2.0, 0.0], [2.0, 0.5], [1.0, 0.5]], "elements": [[0, 1, 2, 3], [1, 4, 5, 6]]},
            ["node 6 lies on a side of element 0", "share their sides"],
        ),
        ({"plane_angle": math.inf}, ["plane_angle", "finite"]),
        (
            {"nodes": [*SQUARE, [5.0, 5.0], [6.0, 5.0], [5.0, 6.0]], "elements": [[0, 1, 2], [0, 2, 3], [4, 5, 6]]},
            ["2 disconnected parts", "node 4"],
        ),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_meshes_are_named(given, words):
    with pytest.raises(InputError) as error:
        mesh(**given)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"angles": [0.1]}, ["has 2 layers", "1 angles"]),
        ({"angles": [0.1, 45.0]}, ["angles[1] = 45.0 rad", "mbd.deg"]),
        ({"angles": [0.1, math.nan]}, ["angles[1] = nan"]),
        ({"angles": 0.3}, ["angles has shape ()"]),
        ({"angles": [0.1, 0.2], "ply": [ISOTROPIC]}, ["1 plies for 2 angles"]),
        ({"angles": [0.1, 0.2], "ply": [ISOTROPIC, "steel"]}, ["'steel'", "a Ply or an Orthotropic"]),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_sections_are_named(given, words):
    with pytest.raises(InputError) as error:
        Section(mesh(layer=[0, 1]), **({"ply": ISOTROPIC} | given))
    for word in words:
        assert word in str(error.value)


def test_a_force_has_six_components():
    with refused("force"):
        Section(mesh(), ISOTROPIC).stress([1.0, 2.0, 3.0])
