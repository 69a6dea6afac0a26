"""Every reader of files: spoilt ones make a result, or an InputError that names the file; no other exception."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import torchmbd as mbd
from tests.extensions import test_windio, test_windio_versions
from tests.extensions.meshes import test_mesh_file
from tests.extensions.nastran import test_nsm
from tests.extensions.nastran.bdf_models import model
from tests.extensions.robots import test_mjcf, test_urdf
from tests.extensions.spoilt import spoilt
from torchmbd.errors import InputError
from torchmbd.extensions.matrices import read_matrix
from torchmbd.extensions.meshes.mesh_file import mesh_file
from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.extensions.robots.mjcf import mjcf_robot
from torchmbd.extensions.robots.urdf import urdf_robot

OP4 = """\
       2       2       6       2KGG     1P,3E23.16
       1       1       2
 2.0000000000000000E+00-1.0000000000000000E+00
       2       1       2
-1.0000000000000000E+00 2.0000000000000000E+00
       3       1       1
 0.0000000000000000E+00
"""
GMSH = """\
$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
1
2 1 "web"
$EndPhysicalNames
$Nodes
4
1 0 0 0
2 1 0 0
3 1 1 0
4 0 1 0
$EndNodes
$Elements
2
1 2 2 1 1 1 2 3
2 2 2 1 1 1 3 4
$EndElements
"""
VTK = """\
# vtk DataFile Version 4.2
a plate
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 4 double
0 0 0 1 0 0 1 1 0 0 1 0
CELLS 2 8
3 0 1 2
3 0 2 3
CELL_TYPES 2
5
5
"""


def _windio() -> str:
    shape = {
        "airfoil_position": {"grid": [0.0, 1.0], "labels": ["root", "tip"]},
        "chord": test_windio.along(2.0, 2.0),
        "twist": test_windio.along(0.2, 0.0),
        "pitch_axis": test_windio.along(0.5, 0.5),
        "reference_axis": {axis: test_windio.along(0.0, 50.0 * (axis == "z")) for axis in "xyz"},
    }
    inner = {"layers": test_windio.FULL, "webs": test_windio.WEBS}
    airfoil = test_windio.wing(n=20)
    data = {
        "components": {"blade": {"outer_shape_bem": shape, "internal_structure_2d_fem": inner}},
        "airfoils": [
            {"name": k, "coordinates": airfoil, "relative_thickness": t} for k, t in (("root", 0.31), ("tip", 0.3))
        ],
        "materials": test_windio.MATERIALS,
    }
    return yaml.safe_dump(data)


def _beamdyn() -> str:
    rows = "\n".join(" ".join(map(str, row)) for row in np.diag([2.0, 2.0, 9.0, 4.0, 3.0, 1.0]).tolist())
    stations = "".join(f"{s}\n{rows}\n\n{rows}\n\n" for s in (0.0, 0.5, 1.0))
    return f"a blade\n3 station_total\n--- Distributed Properties ---\n{stations}"


def _nastran() -> str:
    return "\n".join(
        [
            "SOL 103",
            "CEND",
            "NSM = 5",
            "BEGIN BULK",
            *test_nsm.GRIDS,
            *test_nsm.MODEL,
            "=,*(50),==",
            "NSML1,5,PROD,4.,ALL",
        ]
    )


#: Reader, its files' name, a text that it reads.
READERS: dict[str, tuple[Callable[[Path], Any], str, str]] = {
    "nastran": (bulk_body, "model.bdf", model(cells=(2, 1))),
    "nastran_mass": (bulk_body, "model.bdf", _nastran()),
    "dmig": (
        lambda path: read_matrix(path, "K"),
        "k.dmig",
        "DMIG,KX,0,6,1\nDMIG,KX,3,3,,3,3,100.\n,4,1,7.\nDMIG,KX,4,1,,4,1,5.\n",
    ),
    "op4": (lambda path: read_matrix(path, "K"), "k.op4", OP4 + OP4.replace("KGG", "MGG")),
    "matrix_market": (
        lambda path: read_matrix(path, "K"),
        "k.mtx",
        "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 4.\n2 2 5.\n",
    ),
    "abaqus_matrix": (lambda path: read_matrix(path, "K"), "k.mtx", "1,1,1,1,4.\n1,1,1,2,5.\n1,2,1,2,6.\n"),
    "abaqus_mesh": (mesh_file, "mesh.inp", test_mesh_file.ABAQUS),
    "gmsh": (mesh_file, "mesh.msh", GMSH),
    "vtk": (mesh_file, "mesh.vtk", VTK),
    "urdf": (urdf_robot, "arm.urdf", test_urdf.TEXT),
    "mjcf": (mjcf_robot, "arm.xml", test_mjcf.MECHANISM.replace("><", ">\n<")),
    "windio": (lambda path: mbd.io.read_windio(path).section(0.5, cells=12, order=1), "blade.yaml", _windio()),
    "windio_2": (
        lambda path: mbd.io.read_windio(path).section(0.5, cells=12, order=1),
        "blade.yaml",
        yaml.safe_dump(test_windio_versions.version_2()),
    ),
    "beamdyn": (mbd.io.read_beamdyn, "blade.inp", _beamdyn()),
}


@pytest.mark.thorough("nastran", "nastran_mass", "windio")
@pytest.mark.parametrize("reader", READERS)
def test_spoilt_files(reader, tmp_path):
    read, name, text = READERS[reader]
    path, refused = tmp_path / name, list[str]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path.write_text(text)
        read(path)
        for seed in range(40):
            path.write_bytes(spoilt(text, seed))
            try:
                read(path)
            except InputError as error:
                refused.append(str(error))
            except Exception as error:
                raise AssertionError(f"seed {seed}") from error
    assert len(refused) > 5
    assert all(name in message for message in refused), [message for message in refused if name not in message]
