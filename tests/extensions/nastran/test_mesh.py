"""From cards to a mesh: nodes in the order of the file, zones by property, directions of the material, names."""

import math

import torch
from torch.testing import assert_close

from tests.refused import refused, warned
from torchmbd.extensions.nastran.cards import parse_cards
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.mesh import bulk_mesh

GRIDS = "GRID,10,,0.,0.,0.\nGRID,20,,0.,2.,0.\nGRID,30,,0.,2.,2.\nGRID,40,,0.,0.,2.\nGRID,50,,0.,4.,0."
ELEMENTS = "PSHELL,1,1,.1\nPSHELL,2,1,.1\nCQUAD4,1,2,10,20,30,40,30.\nCTRIA3,2,1,20,50,30,3"
SYSTEM = "CORD2R,3,0,0.,0.,0.,1.,0.,0.\n,0.,0.,1."


def made(text, **given):
    lines = [(f"line {k}", line) for k, line in enumerate(text.splitlines(), start=1)]
    return bulk_mesh(BulkData.of(parse_cards(lines)), **given)


def test_nodes_zones_directions_and_names():
    text = f"{GRIDS}\n{ELEMENTS}\n{SYSTEM}\nSPC1,5,123456,10,40\nCONM2,9,50,0,1.\nRBE2,8,50,123456,20"
    result = made(text, length=0.1)
    mesh = result.mesh
    assert_close(mesh.nodes[result.index[30]], torch.tensor([0.0, 0.2, 0.2], dtype=torch.float64))
    assert {key: len(own) for key, own in result.zones.items()} == {(1, 0.0): 1, (2, 0.0): 1}
    assert (len(mesh.triangles), len(mesh.quads)) == (1, 1)
    assert mesh.cell_name(1) == "CQUAD4 1 (line 8)"
    assert mesh.node_set("spc_5") == (result.index[10], result.index[40])
    assert mesh.node("conm2_9") == mesh.node("rbe2_8") == mesh.node("grid_50") == result.index[50]
    assert mesh.lines.tolist() == [[result.index[50], result.index[20]]]
    # The quadrilateral lies in the y-z plane, normal +x: 30 degrees from its first side (y) towards z.
    expected = torch.tensor([0.0, math.cos(math.pi / 6), math.sin(math.pi / 6)], dtype=torch.float64)
    for k in result.zones[2, 0.0]:
        assert_close(result.direction[k] / result.direction[k].norm(), expected)
    assert_close(result.direction[result.zones[1, 0.0][0]], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert_close(mesh.normals[:, 0], torch.ones(2, dtype=torch.float64))


def test_messages_name_cards():
    with warned("CTRIA3 2 (line 9)", "CTRIA3 7 (line 12)", "duplicates"):
        made(f"{GRIDS}\n{ELEMENTS}\n{SYSTEM}\nCTRIA3,7,1,20,50,30,3")
    more = "\n".join(f"GRID,{k},,{k}.,{k % 3}.,{k % 2}." for k in (70, 71, 73))
    with refused("elements"):
        made(f"{GRIDS}\n{ELEMENTS}\n{SYSTEM}\n{more}\nCTRIA3,7,1,70,71,73,0.")
    with refused("elements"):
        made("MAT1,1,1.,,.3,1.")


def test_grids_at_one_place_and_loose_masses():
    """Grids of a seam stay apart and are joined by what the file says; a mass at a grid of no element is left out, by name."""
    text = f"{GRIDS}\n{ELEMENTS}\n{SYSTEM}\nGRID,60,,0.,2.,0.\nGRID,70,,0.,2.,2.\nGRID,80,,0.,3.,1.\nCTRIA3,7,1,60,80,70,0.\n"
    with warned("CONM2 9", "2 CONM2 with a total mass of 5"):
        result = made(f"{text}RBE2,8,20,123456,60\nGRID,90,,5.,5.,5.\nCONM2,9,90,,2.\nCONM2,11,90,,3.")
    assert len(result.mesh.nodes) == 8
    assert 90 not in result.index
    with refused("elements"):
        made(text)
