"""Arguments of readers that are refused: the error names the argument, its value and what is allowed."""

from __future__ import annotations

from typing import Any

import meshio
import pytest

import torchmbd as mbd
from tests.refused import refused
from torchmbd.errors import InputError

any_: Any = mbd  # calls that a type checker would refuse as well
LAMINATE = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45.0, -45.0]), 1e-3)
CASES = [
    *((lambda x=x: any_.io.read_mesh(x, "b", None), "path = .*: must be a mesh file") for x in (None, [], 3, b"x")),
    *((lambda x=x: any_.io.read_bdf(x, "b"), "path = .*: must be a Nastran") for x in (None, [], 3, b"x")),
    *((lambda x=x: any_.io.read_matrix(x), "path = .*: must be a matrix file") for x in (None, [], 3, b"x")),
    *((lambda x=x: any_.io.read_beamdyn(x), "path = .*: must be a BeamDyn") for x in (None, [], 3, b"x")),
    *((lambda x=x: any_.io.read_windio(x), "path = .*: must be a windIO") for x in (None, [], 3, b"x")),
    *(
        (lambda x=x: any_.lamination.LaminationRules(min_share=x), "min_share = .*: must be 0 to 0.25")
        for x in ("x", [], {})
    ),
    *(
        (lambda x=x: any_.lamination.LaminationRules(max_step=x), "max_step = .*: must be 0 to 90")
        for x in ("x", [], {})
    ),
    (lambda: any_.lamination.LaminationRules(balanced="no"), "balanced = 'no': must be True or False"),
    (lambda: mbd.io.read_bdf("b.bdf", "b", units="inch"), "'inch'.*Try: 'in'"),
    (lambda: any_.io.read_bdf("none.bdf", "r", modes=2, units=3), "units = 3: must be one of "),
]


@pytest.mark.parametrize(("call", "words"), CASES, ids=[str(k) for k in range(len(CASES))])
def test_it_is_refused_by_name(call, words):
    with pytest.raises(InputError, match=words):
        call()


@pytest.fixture
def plate(tmp_path):
    plate = mbd.mesh.rectangle(0.3, 0.06, (4, 2), "triangle")
    meshio.Mesh(plate.nodes.numpy(), [("triangle", plate.triangles.numpy())]).write(tmp_path / "plate.vtk")
    return tmp_path / "plate.vtk"


def test_options_of_a_mesh(plate):
    with pytest.raises(TypeError) as error:
        any_.io.read_mesh(plate, "b", LAMINATE, refrence="center")
    assert error.value.__notes__ == ["Try: reference = ... in place of refrence = 'center'."]
    for x in (None, "x", 3, []):
        with refused("laminate"):
            any_.io.read_mesh(plate, "b", x)
