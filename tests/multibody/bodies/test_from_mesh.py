"""Bodies on meshes from outside: zones with their own laminates, and units that look wrong."""

import math
import sys

import meshio
import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, GENERAL
from torchmbd.errors import InputError
from torchmbd.io.mesh_file import MeshFile

PLATE = mbd.mesh.rectangle(0.3, 0.1, (6, 2), "triangle")


def values(body):
    return torch.linalg.eigvalsh(body.structure()["Kr"].detach())


def test_a_mesh_of_ones_own_is_a_plate():
    made = mbd.FlexibleBody.from_mesh("plate", PLATE, GENERAL, 3, reference="left_edge")
    expected = mbd.FlexibleBody.plate("plate", PLATE, GENERAL, 3, reference="left_edge")
    assert_close(values(made), values(expected))


@pytest.mark.thorough
def test_the_direction_turns_the_laminate():
    """The sum of the plies' shear stiffness is a tensor; that of equal energy is one of the laminate's own axes."""
    turn, thickness = math.radians(30), [1e-3, 2e-3, 1.5e-3]
    one, other = (
        mbd.Laminate(CARBON, mbd.deg(angles), thickness, shear_correction=5 / 6)
        for angles in ([20, -50, 75], [50, -20, 105])
    )
    made = mbd.FlexibleBody.from_mesh("plate", PLATE, one, 3, direction=(math.cos(turn), math.sin(turn), 0.0))
    assert_close(values(made), values(mbd.FlexibleBody.plate("plate", PLATE, other, 3)), rtol=1e-10, atol=0)


def test_a_file_with_two_zones(tmp_path):
    left = np.flatnonzero(PLATE.nodes[PLATE.triangles].mean(1)[:, 0].numpy() < 0)
    right = np.setdiff1d(np.arange(len(PLATE.triangles)), left)
    sets = {
        "cell_sets": {"left": [left], "right": [right]},
        "point_sets": {"root": np.array(PLATE.node_set("left_edge"))},
    }
    file = tmp_path / "plate.inp"
    meshio.Mesh(PLATE.nodes.numpy() * 1e3, [("triangle", PLATE.triangles.numpy())], **sets).write(file)
    zones = {"left": GENERAL, "right": mbd.Laminate(CARBON, mbd.deg([20, -50, 75]), [1e-3, 2e-3, 1.5e-3])}
    body = mbd.FlexibleBody.from_mesh("plate", file, zones, 3, scale=1e-3, reference="root")
    assert [name for name, x in body.named_parameters() if x.requires_grad] == ["left.angles", "right.angles"]
    expected = mbd.FlexibleBody.plate("plate", PLATE, GENERAL, 3, reference="left_edge")
    assert_close(values(body), values(expected), rtol=1e-9, atol=0)
    with pytest.raises(InputError, match=r"zone 'rihgt' does not exist.*did you mean 'right'"):
        mbd.FlexibleBody.from_mesh("plate", file, {"left": GENERAL, "rihgt": GENERAL}, 3)
    with pytest.raises(InputError, match=r"triangle \d+ and 11 others lie in 0 of the zones left; allowed: one zone"):
        mbd.FlexibleBody.from_mesh("plate", file, {"left": GENERAL}, 3)


def test_a_triangle_in_two_zones_is_refused():
    from torchmbd.multibody.bodies.zones import zone_parts

    zones = {"all": torch.arange(len(PLATE.triangles)), "one": torch.tensor([4])}
    with pytest.raises(InputError, match=r"triangle 4 and 0 others lie in 2 of the zones all, one"):
        zone_parts(MeshFile(PLATE, zones), {"all": GENERAL, "one": GENERAL}, (1.0, 0.0, 0.0), "lumped")


def test_without_meshio_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(InputError, match=r"pip install .torchmbd\[mesh\]"):
        mbd.FlexibleBody.from_mesh("plate", tmp_path / "x.msh", GENERAL)
