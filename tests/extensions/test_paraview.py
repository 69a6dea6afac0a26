"""Files for ParaView: read back by an XML parser of our own, and by meshio where it is installed."""

from __future__ import annotations

import base64
import dataclasses
import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

import torchmbd as mbd
from tests.mechanisms import SOFT, pendulum, plate
from tests.refused import refused
from torchmbd.extensions.paraview import save_mesh, save_modes, save_motion
from torchmbd.fem.materials import CRITERIA, Ply, Strength
from torchmbd.math.variable import LayerNumbers
from torchmbd.results.ply_history import PlyHistory

DTYPES = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1"}


def arrays(path) -> dict[str, np.ndarray]:
    """All arrays of a VTU file by name."""
    result = {}
    for element in ET.parse(path).iter("DataArray"):
        raw = base64.b64decode(element.text)
        assert int.from_bytes(raw[:8], "little") == len(raw) - 8
        data = np.frombuffer(raw[8:], DTYPES[element.get("type")])
        width = element.get("NumberOfComponents")
        result[element.get("Name")] = data.reshape(-1, int(width)) if width else data
    return result


@pytest.fixture(scope="module")
def motion() -> mbd.Trajectory:
    system = pendulum()
    strength = Strength(1.5e6, 1.2e6, 4e4, 2.5e5, 7e4)
    result = system.body("rod").laminate
    result._plies = LayerNumbers(result, "ply", (Ply(**SOFT, strength=strength),) * 2)
    return mbd.simulate(system, 0.02, steps=20).require_ok()


def test_the_mesh(tmp_path):
    body = plate("rod")
    result = arrays(save_mesh(body, tmp_path / "rod.vtu"))
    assert_array_equal(result["points"], body.mesh.nodes.numpy())
    assert_array_equal(result["connectivity"].reshape(-1, 4), body.mesh.quads.numpy())
    assert_array_equal(result["offsets"], 4 * np.arange(1, len(body.mesh.quads) + 1))
    assert_array_equal(result["types"], 9)
    assert_array_equal(result["laminate"], 0)
    assert_allclose(result["laminate_x"], np.tile([1.0, 0.0, 0.0], (body.mesh.cell_count, 1)), atol=1e-15)
    for k, theta in enumerate(body.laminate.angles.tolist()):
        expected = np.tile([np.cos(theta), np.sin(theta), 0.0], (body.mesh.cell_count, 1))
        assert_allclose(result[f"fiber_{k + 1}"], expected, atol=1e-15)


def test_a_mesh_of_both_kinds(tmp_path):
    nodes = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]]
    mesh = mbd.Mesh(nodes, [[1, 4, 2]], quads=[[0, 1, 2, 3]])
    result = arrays(save_mesh(mesh, tmp_path / "mesh.vtu"))
    assert_array_equal(result["connectivity"], [1, 4, 2, 0, 1, 2, 3])
    assert_array_equal(result["offsets"], [3, 7])
    assert_array_equal(result["types"], [5, 9])


def test_a_mesh_with_lines(tmp_path):
    mesh = mbd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 2, 0]], [[0, 1, 2]], lines=[[1, 3]])
    result = arrays(save_mesh(mesh, tmp_path / "mesh.vtu"))
    assert_array_equal(result["connectivity"], [0, 1, 2, 1, 3])
    assert_array_equal(result["offsets"], [3, 5])
    assert_array_equal(result["types"], [5, 3])


@pytest.mark.thorough
def test_the_modes(tmp_path):
    """Each field is a mode: K u = omega^2 M u on the free freedoms; its name tells the frequency."""
    body = plate("rod", modes=3)
    result = arrays(save_modes(body, tmp_path / "modes.vtu"))
    names = [name for name in result if name.startswith("mode_")]
    values = torch.linalg.eigvalsh(body.structure()["Kr"].detach()).sqrt() / (2 * torch.pi)
    assert [float(name.split("_")[2].removesuffix("Hz")) for name in names] == pytest.approx(values.tolist(), rel=1e-3)
    psi = body.structure()["psi"].detach()[:, :3].flatten(0, 1)
    for name in names:
        u = torch.from_numpy(result[name].copy()).flatten()
        left = u - psi @ torch.linalg.lstsq(psi, u[:, None]).solution[:, 0]
        assert float(left.norm()) < 1e-9 * float(u.norm())
        assert np.linalg.norm(result[name], axis=1).max() == pytest.approx(0.1 * np.hypot(0.3, 0.1))


def test_the_motion(tmp_path, motion):
    """Every file of the collection exists; nodes, displacements and failure indices are those of the motion."""
    file = save_motion(motion, tmp_path / "swing.pvd", max_frames=6, criterion="tsai_wu")
    sets = list(ET.parse(file).iter("DataSet"))
    times = sorted({float(x.get("timestep")) for x in sets})
    assert times == pytest.approx(motion.t[::4].tolist())
    assert {x.get("name") for x in sets} == {"arm", "rod"}
    rod = [x for x in sets if x.get("name") == "rod"]
    view, plies = motion.body("rod"), PlyHistory(motion, "rod")
    for x in (rod[1], rod[-1]):
        index = int(np.argmin(np.abs(motion.t.numpy() - float(x.get("timestep")))))
        result = arrays(tmp_path / x.get("file"))
        assert_allclose(result["points"], view.nodes[0, index].detach().numpy(), rtol=1e-12)
        u = view.displacements[0, index].detach() @ view.A[0, index].detach().T
        assert_allclose(result["displacement"], u.numpy(), rtol=1e-9, atol=1e-15)
        indices = CRITERIA["tsai_wu"](plies.stress()[0, index], plies.strength[0]).detach()
        worst = [float(indices[plies.points[:, 0] == k].max()) for k in range(view.mesh.cell_count)]
        assert_allclose(result["tsai_wu"], np.maximum(worst, 0.0), rtol=1e-9, atol=1e-15)
    arm = next(x for x in sets if x.get("name") == "arm")
    assert_allclose(
        arrays(tmp_path / arm.get("file"))["points"][0], motion.body("arm").r[0, 0].detach().numpy(), rtol=1e-12
    )


def test_meshio_reads_it(tmp_path, motion):
    file = save_motion(motion, tmp_path / "swing.pvd", max_frames=2)
    first = next(x for x in ET.parse(file).iter("DataSet") if x.get("name") == "rod")
    result = meshio.read(tmp_path / first.get("file"))
    assert_allclose(result.points, motion.body("rod").nodes[0, 0].detach().numpy())
    assert_array_equal(result.cells_dict["quad"], motion.body("rod").mesh.quads.numpy())
    assert result.point_data["displacement"].shape == (15, 3)


@pytest.mark.parametrize(
    ("given", "argument"),
    [
        ({"path": "x.vtk"}, "path"),
        ({"lane": 1}, "lane"),
        ({"max_frames": 1}, "max_frames"),
        ({"criterion": "tsai"}, "criterion"),
    ],
)
def test_bad_arguments(tmp_path, motion, given, argument):
    path = tmp_path / given.pop("path", "x.pvd")
    with refused(argument):
        save_motion(motion, path, **given)


@pytest.mark.thorough
def test_a_failed_lane_has_nothing_to_show(tmp_path, motion):
    failed = dataclasses.replace(motion, status=["failed: no reason"])
    with refused("lane", 0):
        save_motion(failed, tmp_path / "x.pvd")
    with refused("path"):
        save_mesh(plate("rod"), tmp_path / "rod.vtk")
