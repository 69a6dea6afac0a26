"""Bodies on meshes from outside: zones with their own laminates, and units that look wrong."""

import sys

import meshio
import numpy as np
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, GENERAL
from tests.refused import ANY, refused
from torchmbd.extensions.meshes.mesh_file import MeshFile

PLATE = mbd.mesh.rectangle(0.3, 0.1, (6, 2), "triangle")


def values(body):
    return torch.linalg.eigvalsh(body.structure()["Kr"].detach())


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
    body = mbd.io.read_mesh(file, "plate", zones, 3, scale=1e-3, reference="root")
    assert [name for name, x in body.named_parameters() if x.requires_grad] == ["left.angles", "right.angles"]
    expected = mbd.FlexibleBody.plate("plate", PLATE, GENERAL, 3, reference="left_edge")
    assert_close(values(body), values(expected), rtol=1e-9, atol=0)
    with refused("zone", "rihgt", meant="right"):
        mbd.io.read_mesh(file, "plate", {"left": GENERAL, "rihgt": GENERAL}, 3)
    with refused("laminate", ANY, "11 others", "0 of the zones left"):
        mbd.io.read_mesh(file, "plate", {"left": GENERAL}, 3)


def test_a_triangle_in_two_zones_is_refused():
    from torchmbd.extensions.meshes.zones import zone_parts

    zones = {"all": torch.arange(len(PLATE.triangles)), "one": torch.tensor([4])}
    with refused("laminate", ANY, "triangle 4 and 0 others", "2 of the zones all, one"):
        zone_parts(MeshFile(PLATE, zones), {"all": GENERAL, "one": GENERAL}, (1.0, 0.0, 0.0), "lumped")


def test_without_meshio_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "meshio", None)
    with refused("path", ANY, "meshio", "pip install 'torchmbd[mesh]'"):
        mbd.io.read_mesh(tmp_path / "x.msh", "plate", GENERAL)
