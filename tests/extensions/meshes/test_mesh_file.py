"""Meshes through meshio: zones, node sets, unused points, scale, in three formats; and what is refused."""

import math

import meshio
import numpy as np
import pytest
import torch

from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.extensions.meshes.mesh_file import mesh_file, mesh_of, meters

POINTS = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]], dtype=float)
QUADS, TRIANGLES = np.array([[0, 1, 4, 5]]), np.array([[1, 2, 3], [1, 3, 4]])


def written(tmp_path, name, **given):
    file = tmp_path / name
    meshio.Mesh(POINTS, [("quad", QUADS), ("triangle", TRIANGLES)], **given).write(file)
    return file


@pytest.mark.parametrize("name", ["plate.vtk", "plate.vtu", "plate.inp"])
def test_geometry_in_every_format(tmp_path, name):
    """Point 6 belongs to no element and is left out; millimeters become meters."""
    mesh, zones = mesh_file(written(tmp_path, name), scale=1e-3)
    assert len(mesh.nodes) == 6
    assert (len(mesh.triangles), len(mesh.quads)) == (2, 1)
    assert float(mesh.areas.sum()) == pytest.approx(2e-6)
    assert zones == {}


ABAQUS = """\
*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 2., 0., 0.
4, 2., 1., 0.
5, 1., 1., 0.
6, 0., 1., 0.
*ELEMENT, TYPE=S4R, ELSET=web
10, 1, 2, 5, 6
*ELEMENT, TYPE=S3, ELSET=flange
20, 2, 3, 4
21, 2, 4, 5
*ELSET, ELSET=skin
10, 20
*ELSET, ELSET=both
web, flange
*NSET, NSET=tip
3, 4
"""


def test_sets_of_abaqus(tmp_path):
    """Sets of elements are zones (a set of sets is not read); triangles are counted first."""
    file = tmp_path / "plate.inp"
    file.write_text(ABAQUS)
    mesh, zones = mesh_file(file)
    assert mesh.node_set("tip") == (2, 3)
    assert {name: len(own) for name, own in zones.items()} == {"web": 1, "flange": 2, "skin": 2}
    assert float(mesh.areas[zones["skin"]].sum()) == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("*NSET", "*NODE\n7, 9., 9., 9.\n*NSET", ["line 17", "*NODE appears twice"]),
        ("*NSET", "*INCLUDE, INPUT=none.inp\n*NSET", ["line 17", "*INCLUDE of 'none.inp'"]),
        ("*NSET", "*INCLUDE, INPUT=plate.inp\n*NSET", ["*INCLUDE in a circle"]),
        ("*NSET", "*INCLUDE\n*NSET", ["line 17", "*INCLUDE of"]),
        ("*NSET", "*ELGEN, ELSET=web\n10, 3\n*NSET", ["line 17", "*ELGEN is not read"]),
        (
            "*NSET",
            "*NONSTRUCTURAL MASS, ELSET=web, UNITS=MASS PER AREA\n3.\n*NSET",
            ["*NONSTRUCTURAL MASS is not read"],
        ),
        ("*NSET", "*Tie, name=a\nx, y\n*NSET", ["*TIE is not read"]),
        ("*NSET", "*INSTANCE, NAME=a, PART=b\n1., 0., 0.\n*NSET", ["line 17", "*INSTANCE is moved"]),
        (
            "*NSET",
            "*INSTANCE, NAME=a, PART=b\n*END INSTANCE\n*INSTANCE, NAME=c, PART=b\n*NSET",
            ["line 19", "*INSTANCE"],
        ),
        ("*NSET", "*ELEMENT, TYPE=B31\n30, 1, 2\n*NSET", ["plate.inp", "beams, rods or masses"]),
        ("*NSET", "*ELEMENT, TYPE=MASS\n30, 1\n*NSET", ["plate.inp", "MASS"]),
    ],
)
def test_what_meshio_loses_of_abaqus(old, new, words, tmp_path):
    """Nodes, elements, masses and ties that its reader skips are refused by file, line and keyword."""
    file = tmp_path / "plate.inp"
    file.write_text(ABAQUS.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        mesh_file(file)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_what_abaqus_writes_besides_is_left_out(tmp_path):
    """Sections, materials, supports and steps; a file that is included."""
    file = tmp_path / "plate.inp"
    (tmp_path / "mesh.inp").write_text(ABAQUS)
    more = "*SHELL SECTION, ELSET=web, MATERIAL=AL\n.01\n*MATERIAL, NAME=AL\n*ELASTIC\n7e10, .3\n*DENSITY\n2700.\n"
    more += "*BOUNDARY\ntip, 1, 6\n"
    file.write_text(f"*HEADING\n*INCLUDE, INPUT=mesh.inp\n{more}*STEP\n*FREQUENCY\n5\n*MODEL CHANGE\n")
    assert float(mesh_file(file).mesh.areas.sum()) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("*NODE", "*NODE, SYSTEM=C", "line 1: *NODE, SYSTEM is not read"),
        ("*NODE", "*NODE, INPUT=nodes.txt", "line 1: *NODE, INPUT is not read"),
        ("TYPE=S4R", "TYPE=S4R, OFFSET=0.5", "*ELEMENT, OFFSET is not read"),
        ("*ELSET, ELSET=skin", "*ELSET, ELSET=web", "ELSET 'web' is given in *ELEMENT and in *ELSET"),
    ],
)
def test_options_that_meshio_passes_over_are_refused(tmp_path, old, new, words):
    file = tmp_path / "plate.inp"
    file.write_text(ABAQUS.replace(old, new))
    with pytest.raises(InputError) as error:
        mesh_file(file)
    assert words in str(error.value)


@pytest.mark.parametrize("names", [("skin", "skin", "web"), ("", "skin", "web"), ("web", "skin", "skin")])
def test_zones_of_blocks_that_share_a_name_or_have_none(tmp_path, names):
    """The area of each zone is the sum over the lines of the file."""
    heads = [", ELSET=" + name if name else "" for name in names]
    nodes = ABAQUS[: ABAQUS.index("*ELEMENT")]
    blocks = (("S4R", "10, 1, 2, 5, 6"), ("S3", "20, 2, 3, 4"), ("S3", "30, 2, 4, 5"))
    text = "".join(f"*ELEMENT, TYPE={kind}{head}\n{line}\n" for head, (kind, line) in zip(heads, blocks, strict=True))
    file = tmp_path / "plate.inp"
    file.write_text(nodes + text)
    mesh, zones = mesh_file(file)
    expected: dict[str, float] = {}
    for name, area in zip(names, (1.0, 0.5, 0.5), strict=True):
        if name:
            expected[name] = expected.get(name, 0.0) + area
    assert {name: float(mesh.areas[members].sum()) for name, members in zones.items()} == pytest.approx(expected)


def test_named_edges_of_abaqus(tmp_path):
    """Mesh generators write named edges as trusses without a section."""
    edge = "*ELEMENT, TYPE=T3D2, ELSET=root\n1, 1, 6\n*ELEMENT, TYPE=S4R"
    file = tmp_path / "plate.inp"
    file.write_text(ABAQUS.replace("*ELEMENT, TYPE=S4R", edge))
    mesh, zones = mesh_file(file)
    assert mesh.node_set("root") == (0, 5)
    assert {name: len(members) for name, members in zones.items()} == {"web": 1, "flange": 2, "skin": 2}
    file.write_text(file.read_text() + "*SOLID SECTION, ELSET=root, MATERIAL=AL\n1e-4\n")
    with refused("plate.inp.elements"):
        mesh_file(file)


NASTRAN = """\
BEGIN BULK
CORD2C,5,0,0.,0.,0.,0.,0.,1.,+
+,1.,0.,0.
GRID,1,,0.,0.,0.
GRID,2,0,2.,0.,0.
GRID,3,0,2.,1.,0.
GRID,4,,0.,1.,0.
GRID,5,,1.,2.,0.
CQUAD4,1,7,1,2,3,4
CTRIA3,2,7,4,3,5
PSHELL,7,1,.001,1
MAT1,1,7.+10,,.3,2700.
SPC1,1,123456,1,4
EIGRL,1,,,5
ENDDATA
"""


def test_a_shell_of_nastran(tmp_path):
    file = tmp_path / "plate.bdf"
    file.write_text(NASTRAN)
    assert float(mesh_file(file).mesh.areas.sum()) == pytest.approx(2.0 + 1.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("GRID,2,0,", "GRID,2,5,", "GRID 2 (plate.bdf, line 5): CP = 5"),
        ("GRID,2,0,2.,0.,0.", "GRID*,2,5,2.,0.\n*,0.", "GRID 2 (plate.bdf, line 5): CP = 5"),
        ("GRID,1,", "GRDSET,,5\nGRID,1,", "defaults of GRID"),
        ("CQUAD4,1,7,1,2,3,4", "CQUAD4,1,7,1,2,3,4,0.,.01", "CQUAD4 1 (plate.bdf, line 9): ZOFFS"),
        ("CTRIA3,2,7,4,3,5", "CTRIA3,2,7,4,3,5,0.,.01", "CTRIA3 2 (plate.bdf, line 10): ZOFFS"),
        ("CQUAD4,1,7,1,2,3,4", "CQUAD4,1,7,1,2,3,4,45.", "CQUAD4 1 (plate.bdf, line 9): THETA = 45."),
        ("CTRIA3,2,7,4,3,5", "CTRIA3,2,7,4,3,5,5", "CTRIA3 2 (plate.bdf, line 10): THETA = 5"),
        ("SPC1", "CONM2,9,3,0,5.\nSPC1", "CONM2 9 (plate.bdf, line 13)"),
        ("SPC1", "RBE2,9,1,123,2\nSPC1", "RBE2 9 (plate.bdf, line 13)"),
        ("SPC1", "CELAS2,9,1.,1,1,2,1\nSPC1", "CELAS2 9 (plate.bdf, line 13)"),
        ("SPC1", "MPC,9,1,1,1.,2,1,-1.\nSPC1", "MPC 9 (plate.bdf, line 13)"),
        ("SPC1", "CSHEAR,9,7,1,2,3,4\nSPC1", "CSHEAR 9 (plate.bdf, line 13)"),
        ("SPC1", "CBAR,9,7,1,2,0.,0.,1.\nSPC1", "CBAR 9 (plate.bdf, line 13)"),
        ("SPC1", "UNKNOWN,9\nSPC1", "UNKNOWN 9 (plate.bdf, line 13)"),
        ("SPC1", "INCLUDE 'more.bdf'\nSPC1", "meshio reads 5 nodes and 2 cells: must read 6 and 2"),
    ],
)
def test_what_meshio_loses_of_nastran_is_refused(tmp_path, old, new, words):
    (tmp_path / "more.bdf").write_text("GRID,8,,3.,3.,0.\n")
    file = tmp_path / "plate.bdf"
    file.write_text(NASTRAN.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        mesh_file(file)
    assert words in str(error.value)
    assert "mbd.io.read_bdf" in str(error.value)


def test_physical_groups_of_gmsh(tmp_path):
    """Named surfaces are zones; a named point and a named curve are node sets."""
    cells = [("vertex", np.array([[3]])), ("line", np.array([[0, 5]])), ("quad", QUADS), ("triangle", TRIANGLES)]
    tags = [np.array([4]), np.array([3]), np.array([1]), np.array([2, 2])]
    fields = {"web": np.array([1, 2]), "flange": np.array([2, 2]), "root": np.array([3, 1]), "bolt": np.array([4, 0])}
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    file = tmp_path / "plate.msh"
    meshio.write(file, meshio.Mesh(POINTS[:6], cells, cell_data=data, field_data=fields), file_format="gmsh22")
    mesh, zones = mesh_file(file)
    assert {name: len(own) for name, own in zones.items()} == {"web": 1, "flange": 2}
    assert mesh.node("bolt") == 3
    assert mesh.node_set("root") == (0, 5)
    assert zones["web"].tolist() == [2]
    assert float(mesh.nodes[mesh.quads[0]][..., 0].max()) == 1.0


GROUPS = '$PhysicalNames\n2\n2 1 "all"\n2 2 "left"\n$EndPhysicalNames\n'
SIX = "0 0 0\n1 0 0\n2 0 0\n0 1 0\n1 1 0\n2 1 0\n"


def test_a_surface_in_two_groups_of_gmsh_counts_once(tmp_path):
    """Format 4.1 names both groups of a surface; format 2.2 writes its cells once for each group, which is refused."""
    file = tmp_path / "plate.msh"
    entities = "$Entities\n0 0 2 0\n1 0 0 0 1 1 0 2 1 2 0\n2 1 0 0 2 1 0 1 1 0\n$EndEntities\n"
    nodes = f"$Nodes\n1 6 1 6\n2 1 0 6\n1\n2\n3\n4\n5\n6\n{SIX}$EndNodes\n"
    cells = "$Elements\n2 2 1 2\n2 1 3 1\n1 1 2 5 4\n2 2 3 1\n2 2 3 6 5\n$EndElements\n"
    file.write_text(f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{GROUPS}{entities}{nodes}{cells}")
    mesh, zones = mesh_file(file)
    assert float(mesh.areas.sum()) == pytest.approx(2.0)
    assert {name: members.tolist() for name, members in zones.items()} == {"all": [0, 1], "left": [0]}
    numbered = "".join(f"{k} {line}\n" for k, line in enumerate(SIX.splitlines(), start=1))
    cells = "$Elements\n3\n1 3 2 1 1 1 2 5 4\n2 3 2 2 1 1 2 5 4\n3 3 2 1 2 2 3 6 5\n$EndElements\n"
    file.write_text(f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n{GROUPS}$Nodes\n6\n{numbered}$EndNodes\n{cells}")
    with refused("plate.msh.cells.1", ANY, "quad 0 and quad 1"):
        mesh_file(file)


@pytest.mark.parametrize(("kind", "nodes"), [(18, 15), (13, 18)])
def test_wedges_of_gmsh_are_refused(kind, nodes, tmp_path):
    """meshio cannot read those of 15 nodes, and leaves the nodes of the others in gmsh's order."""
    places = "".join(f"{k} {np.cos(k)} {np.sin(k)} {k}\n" for k in range(1, nodes + 1))
    cell = f"1 {kind} 2 1 1 {' '.join(map(str, range(1, nodes + 1)))}"
    head = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
    file = tmp_path / "solid.msh"
    file.write_text(f"{head}$Nodes\n{nodes}\n{places}$EndNodes\n$Elements\n1\n{cell}\n$EndElements\n")
    with pytest.raises(InputError, match=f"solid.msh: .*wedge{nodes}"):
        mesh_file(file)


def test_what_cannot_be_read_is_refused(tmp_path):
    with refused("path"):
        mesh_file(tmp_path / "none.msh")
    with refused("scale", 0.0):
        mesh_file(written(tmp_path, "plate.vtk"), scale=0.0)
    solid = meshio.Mesh(POINTS, [("triangle6", np.arange(6)[None])])
    with refused("elements", "triangle6"):
        mesh_of(solid)
    with refused("elements"):
        mesh_of(meshio.Mesh(POINTS, [("line", np.array([[0, 1]]))]))
    (tmp_path / "bad.vtu").write_text("<VTKFile")
    with refused("path", ANY, "bad.vtu: ", "meshio"):
        mesh_file(tmp_path / "bad.vtu")
    (tmp_path / "bad.xyz").write_text("nothing")
    with refused("path", ANY, "bad.xyz: ", "meshio"):
        mesh_file(tmp_path / "bad.xyz")


def test_a_flat_mesh_of_two_coordinates():
    mesh, _ = mesh_of(meshio.Mesh(POINTS[:6, :2], [("triangle", TRIANGLES)]))
    assert torch.equal(mesh.nodes[:, 2], torch.zeros(len(mesh.nodes), dtype=torch.float64))


def test_lengths_of_files():
    assert (meters("scale", "in"), meters("scale", 1e-3), meters("scale", "ft")) == (0.0254, 1e-3, 0.3048)
    for given in ("deg", "inch", 0.0, -1.0, None, math.inf, True):
        with refused("scale"):
            meters("scale", given)
