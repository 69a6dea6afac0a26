"""Members of the family of reductions on a body: fixed against updated modes, and the energy of a motion by each."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.func import functional_call, jvp

import torchmbd as mbd
from tests.mechanisms import laminate, plate
from torchmbd.fem.reduction import CraigBampton, VibrationModes
from torchmbd.study.file.load import load_study

ANGLES = mbd.deg([20.0, -50.0, 75.0])
DIRECTION = torch.tensor([0.7, -0.4, 1.0], dtype=torch.float64)
INTERFACE = {"vibration": (), "craig-bampton": ("left", "right")}


class _Structure(torch.nn.Module):
    def __init__(self, body: mbd.FlexibleBody) -> None:
        super().__init__()
        self.body = body

    def forward(self) -> dict[str, torch.Tensor]:
        return self.body.structure()


def stage(reduction: str, updated: bool):
    """From angles to the structure of a plate."""
    body = plate("plate", modes=3, reduction=reduction, interface=INTERFACE[reduction], updated=updated)
    module = _Structure(body)
    return body, lambda angles: functional_call(module, {"body.laminate.angles": angles}, ())


@pytest.mark.thorough
@pytest.mark.parametrize("reduction", INTERFACE)
def test_fixed_modes_have_the_values_of_updated_ones_and_only_psi_dK_psi(reduction):
    body, fixed = stage(reduction, False)
    _, updated = stage(reduction, True)
    value, change = jvp(fixed, (ANGLES,), (DIRECTION,))
    for name, x in updated(ANGLES).items():
        torch.testing.assert_close(value[name], x, rtol=1e-9, atol=1e-9 * float(x.detach().abs().max()))
    assert all(not change[name].any() for name in change if name != "Kr")
    dK = jvp(
        lambda angles: body.matrices.stiffness(
            functional_call(_Entries(body.laminate), {"of.angles": angles}, ())
        ).dense(),
        (ANGLES,),
        (DIRECTION,),
    )[1]
    psi = value["psi"].flatten(0, 1)
    expected = psi.T @ dK @ psi
    torch.testing.assert_close(change["Kr"], expected, rtol=0, atol=1e-10 * float(expected.abs().max()))
    exact = jvp(updated, (ANGLES,), (DIRECTION,))[1]
    assert exact["psi"].abs().max() > 1e-3 * value["psi"].abs().max()


class _Entries(torch.nn.Module):
    def __init__(self, of: mbd.Laminate) -> None:
        super().__init__()
        self.of = of

    def forward(self) -> torch.Tensor:
        return self.of.entries()


@pytest.mark.thorough
@pytest.mark.parametrize("reduction", INTERFACE)
def test_derivatives_of_the_updated_stage_are_differences(reduction):
    """Invariants under turns of the basis: the compliance at two nodes, and the modal mass that shakes with the frame."""
    body, updated = stage(reduction, True)
    nodes = [body.mesh.node("left"), body.mesh.node("corner_right_top")]

    def invariant(angles):
        made = updated(angles)
        Y = made["psi"][nodes, :3].flatten(0, 1)
        return torch.cat(
            [1e6 * (Y @ torch.linalg.inv(made["Kr"]) @ Y.T).flatten(), (made["S1"] @ made["S1"].T).flatten()]
        )

    def central(h):
        return (invariant(ANGLES + h * DIRECTION) - invariant(ANGLES - h * DIRECTION)) / (2 * h)

    expected = (4 * central(5e-4) - central(1e-3)) / 3
    result = jvp(invariant, (ANGLES,), (DIRECTION,))[1]
    assert torch.linalg.norm(result - expected) < 1e-7 * torch.linalg.norm(expected)


@pytest.mark.thorough
def test_craig_bampton_answers_interface_loads_exactly():
    """No fixed-interface mode at all: the static answer of the whole mesh to loads at both ends."""
    body = plate("plate", modes=0, reduction="craig-bampton", interface=("left", "right"))
    assert body.modes == 12
    made = {name: x.detach() for name, x in body.structure().items()}
    K = body.matrices.stiffness(body.laminate.entries().detach()).dense()
    load = torch.zeros(len(body.mesh.nodes), 6, dtype=torch.float64)
    load[body.mesh.node("left"), 2], load[body.mesh.node("right"), 3] = 1.0, -0.1
    load = load.flatten()
    exact = torch.zeros_like(load)
    exact[body.free] = torch.linalg.solve(K[body.free][:, body.free], load[body.free])
    psi = made["psi"].flatten(0, 1)
    result = psi @ torch.linalg.solve(made["Kr"], psi.T @ load)
    torch.testing.assert_close(result, exact, rtol=0, atol=1e-9 * float(exact.abs().max()))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"reduction": "craig bampton"}, ["plate.reduction", "'craig bampton'", "Try: 'craig-bampton'"]),
        ({"reduction": "craig-bampton"}, ["'plate'", "interface is empty", "at least one node"]),
        ({"interface": "left"}, ["'plate'", "interface is given", "'vibration'"]),
        ({"reduction": "craig-bampton", "interface": ["left", "left"]}, ["plate.interface", "each once"]),
        ({"reduction": "craig-bampton", "interface": "center"}, ["plate.interface", "not references"]),
        ({"reduction": "craig-bampton", "interface": "lft"}, ["'lft'", "Try: 'left'"]),
        ({"reduction": "craig-bampton", "interface": "left", "modes": 79}, ["plate.modes", "79", "0 to 78"]),
    ],
    ids=str,
)
def test_bad_input_is_named(given, words):
    with pytest.raises(mbd.InputError) as error:
        plate("plate", made_of=laminate(), **given)
    for word in words:
        assert word in str(error.value)
    assert error.value.allowed or error.value.hint


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("overrides", "reduction"),
    [
        (["options.updated=false"], VibrationModes(8, (), False)),
        (["options.reduction=craig-bampton", "options.interface=[left, right]", "options.modes=2"], CraigBampton),
    ],
)
def test_experiment_files_reach_the_reductions(overrides, reduction):
    file = Path(__file__).parents[2] / "configs" / "slider_crank" / "l1_energy_integral.yaml"
    result = load_study(file, overrides).system.body("rod")
    if isinstance(reduction, VibrationModes):
        assert result.reduction == reduction
    else:
        assert isinstance(result.reduction, reduction)
        assert (result.reduction.n, result.modes) == (2, 14)
