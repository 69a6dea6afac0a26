"""What extensions make, such as readers of files, does not depend on torch's default dtype."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.contracts.test_default_dtype import check, default
from tests.extensions.robots.test_robot import ARM
from tests.extensions.robots.test_robot_mjcf import MECHANISM
from tests.mechanisms import pendulum, tensor

BARS = """BEGIN BULK
MAT1,1,2.+11,,.25,8000.
PBAR,5,1,2.7001,1.-3,2.-3,2.-3,.1
+,,,,,,,,
+,.83,.81
PBEAM,6,1,1.1-2,1.3-5,1.7-5,1.-6,2.3-5
PSHELL,7,1,.0123,1,,1
PSOLID,8,1
GRID,1,,0.,0.,0.
GRID,2,,.1,0.,0.
GRID,3,,.2,.03,0.
GRID,4,,.3,.03,.01
GRID,5,,.3,.2,.01
GRID,6,,.2,.2,0.
GRID,7,,.3,.1,.3
CBAR,1,5,1,2,0.,1.,0.
CBEAM,2,6,2,3,0.,1.,.3
CQUAD4,3,7,3,4,5,6
CTRIA3,4,7,4,5,7
CTETRA,5,8,3,4,6,7
CELAS2,7,1.1+5,6,3
CONM2,8,5,,.3,.01,.02,.03
+,.1,.01,.2,.02,.01,.3
SPC1,1,123456,1
ENDDATA
"""


def bulk(folder: Path) -> list[Tensor]:
    (folder / "model.bdf").write_text(BARS)
    return list(mbd.io.read_bdf(folder / "model.bdf", "body", 4).structure().values())


def robot(folder: Path) -> list[Tensor]:
    (folder / "arm.urdf").write_text('<robot name="arm">\n' + "\n".join(ARM) + "\n</robot>\n")
    result = mbd.simulate(mbd.io.read_urdf(folder / "arm.urdf"), 0.01, steps=4)
    return [result.q, result.v, result.a]


def scene(folder: Path) -> list[Tensor]:
    (folder / "arm.xml").write_text(MECHANISM)
    result = mbd.simulate(mbd.io.read_mjcf(folder / "arm.xml"), 0.01, steps=4)
    return [result.q, result.v, result.a]


def swings(folder: Path) -> list[Tensor]:
    rest = mbd.equilibrium(pendulum())
    return [rest.frequencies, rest.poles.abs(), rest.damping_ratios]


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("case", [bulk, robot, scene, swings])
def test_results_are_those_of_float64(case, dtype, tmp_path):
    check(case, dtype, tmp_path)


def test_masses_of_bars(tmp_path):
    """The area is not rounded to the default dtype."""
    (tmp_path / "bar.bdf").write_text(
        "BEGIN BULK\nMAT1,1,2.+11,,.25,1.\nPBAR,5,1,2.7001,1.-3,2.-3,2.-3\nGRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\n"
        "CBAR,1,5,1,2,0.,1.,0.\nSPC1,1,123456,1\nENDDATA\n"
    )
    for dtype in (torch.bfloat16, torch.float32):
        with default(dtype):
            body = mbd.io.read_bdf(tmp_path / "bar.bdf", "bar", 2)
        assert_close(body.structure()["mass"], tensor(2.7001)[0], rtol=1e-14, atol=0)
