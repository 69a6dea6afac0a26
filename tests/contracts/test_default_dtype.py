"""Numbers do not depend on torch's default dtype: no file of the package makes a floating tensor that is not float64."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, laminate, pendulum, plate, tensor
from tests.multibody.system.test_robot import ARM
from tests.multibody.system.test_robot_mjcf import MECHANISM
from torchmbd.examples import two_link_arm

PACKAGE = str(Path(mbd.__file__).parent)
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


class Precision(TorchDispatchMode):
    """Collects the lines of the package that make floating tensors of another precision."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        for x in found if isinstance(found, (tuple, list)) else (found,):
            if isinstance(x, Tensor) and x.is_floating_point() and x.dtype != torch.float64:
                self.lines.add(f"{_line()} {func}")
        return found


def _line() -> str:
    frame = sys._getframe(2)
    while frame and not frame.f_code.co_filename.startswith((PACKAGE, __file__)):
        frame = frame.f_back
    return f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame else "elsewhere"


@contextmanager
def default(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def motion(system: mbd.System, name: str, gradients: str = "auto") -> list[Tensor]:
    """Values and gradients of a motion."""
    found = mbd.simulate(system, 0.02, steps=4, backend="eager", gradients=gradients)
    value = found.q.square().sum() + mbd.Max(mbd.StrainEnergy(name))(found).sum()
    by = torch.autograd.grad(value, [x for x in system.parameters() if x.requires_grad], allow_unused=True)
    return [found.q, found.lam, *(x for x in by if x is not None)]


def bulk(folder: Path) -> list[Tensor]:
    (folder / "model.bdf").write_text(BARS)
    return list(mbd.FlexibleBody.from_bdf("body", folder / "model.bdf", 4).structure().values())


def robot(folder: Path) -> list[Tensor]:
    (folder / "arm.urdf").write_text('<robot name="arm">\n' + "\n".join(ARM) + "\n</robot>\n")
    found = mbd.simulate(mbd.System.from_urdf(folder / "arm.urdf"), 0.01, steps=4)
    return [found.q, found.v, found.a]


def scene(folder: Path) -> list[Tensor]:
    (folder / "arm.xml").write_text(MECHANISM)
    found = mbd.simulate(mbd.System.from_mjcf(folder / "arm.xml"), 0.01, steps=4)
    return [found.q, found.v, found.a]


def sections(folder: Path) -> list[Tensor]:
    ply = mbd.examples.carbon()
    tube = mbd.sections.tube(0.02, ply, mbd.deg([30.0, -20.0]), thickness=mbd.variable(1e-3), cells=(8, 1))
    line = mbd.BeamLine.straight(mbd.variable(0.7), elements=3)
    body = mbd.FlexibleBody.beam("beam", line, tube, modes=3, reference="start", twist=0.3).damped(0.01)
    column = mbd.ExactBeam("column", mbd.BeamLine.straight(1.0, elements=4), tube)
    return [
        tube.stiffness(),
        tube.mass(),
        *body.structure().values(),
        column.equilibrium({"end": (1e3, 10.0, 5.0)}).nodes,
    ]


def statics(folder: Path) -> list[Tensor]:
    system = pendulum()
    rest = mbd.equilibrium(system)
    return [rest.q, rest.lam, rest.frequencies]


def stiffened(folder: Path) -> list[Tensor]:
    return list(plate("rod", 2, stiffening=True, kind="triangle").structure().values())


def pairs(folder: Path) -> list[Tensor]:
    K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64)
    found = mbd.eigenpairs(K, torch.ones(3, dtype=torch.float64), 2)
    rigid = mbd.RigidBody("box", 1.3, (0.1, 0.2, 0.3), position=(0.1, 0.2, 0.7))
    return [*found, rigid.position, rigid.invariants()["P0"], laminate().entries()]


def bent(folder: Path) -> list[Tensor]:
    rod = plate("rod", 3, made_of=laminate((20.0, -50.0), 3e-3, SOFT)).bent([1e-3, -7e-4, 3e-4])
    hinge = mbd.Revolute(mbd.Ground().at(), rod.at("left"), axis="x", name="hinge")
    return motion(mbd.System([rod], [hinge], gravity=GRAVITY), "rod")


CASES: dict[str, Callable[[Path], list[Tensor]]] = {
    "motion": lambda _: motion(two_link_arm.build(cells=(4, 2), modes=2), "upper"),
    "examples": lambda _: motion(mbd.examples.arm(), "arm", gradients="forward"),
    "bent": bent,
    "bulk data": bulk,
    "urdf": robot,
    "mjcf": scene,
    "sections": sections,
    "statics": statics,
    "stiffened": stiffened,
    "pairs": pairs,
}


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize("case", CASES)
def test_results_are_those_of_float64(case, dtype, tmp_path):
    with default(torch.float64):
        wanted = CASES[case](tmp_path)
    with default(dtype), Precision() as precision:
        found = CASES[case](tmp_path)
    assert not precision.lines
    for x, y in zip(found, wanted, strict=True):
        assert x.dtype == torch.float64
        assert_close(x.detach(), y.detach(), rtol=1e-12, atol=1e-12 * float(y.detach().norm()))


def test_masses_of_bars(tmp_path):
    """The area is not rounded to the default dtype."""
    (tmp_path / "bar.bdf").write_text(
        "BEGIN BULK\nMAT1,1,2.+11,,.25,1.\nPBAR,5,1,2.7001,1.-3,2.-3,2.-3\nGRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\n"
        "CBAR,1,5,1,2,0.,1.,0.\nSPC1,1,123456,1\nENDDATA\n"
    )
    for dtype in (torch.bfloat16, torch.float32):
        with default(dtype):
            body = mbd.FlexibleBody.from_bdf("bar", tmp_path / "bar.bdf", 2)
        assert_close(body.structure()["mass"], tensor(2.7001)[0], rtol=1e-14, atol=0)
