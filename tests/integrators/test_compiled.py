"""Compiled steps: keys, faults of the cache, and (slow) the same numbers as the eager route."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import torchmbd as mbd
from experiments.slider_crank import build
from tests.mechanisms import box, plate
from torchmbd.cli import main
from torchmbd.integrators import compiled
from torchmbd.integrators.generalized_alpha import initial
from torchmbd.integrators.step import Coefficients
from torchmbd.system import Dynamics

ANGLES = mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])
NAME = "rod.laminate.angles"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCHMBD_CACHE", str(tmp_path))
    monkeypatch.setenv("TORCHMBD_COMPILE", "1")
    monkeypatch.setattr(compiled, "_loaded", {})
    monkeypatch.setattr(compiled, "_seen", {})
    return tmp_path


def dynamics(modes: int = 3, tangents: bool = True) -> Dynamics:
    return build(3, cells=(6, 2), modes=modes).dynamics({NAME: ANGLES}, tangents=[NAME] if tangents else [])


def model(d: Dynamics) -> compiled.CompiledModel | None:
    return compiled.CompiledModel.of(d, initial(d), Coefficients(0.9).weights(1e-4))


def key(d: Dynamics) -> str:
    return compiled.key(d.topology, compiled.Signature.of(d))


def test_keys_tell_topologies_and_tangents_apart() -> None:
    keys = [key(dynamics()), key(dynamics(modes=4)), key(dynamics(tangents=False))]
    assert len(set(keys)) == 3
    assert keys[0] == key(dynamics())


def test_a_corrupt_package_is_removed_and_the_eager_route_serves(cache: Path) -> None:
    d = dynamics()
    folder = cache / key(d)
    folder.mkdir()
    for operation in compiled.operations(compiled.Signature.of(d)):
        (folder / f"{operation}.pt2").write_bytes(b"no package")
    (folder / "ready").touch()
    with pytest.warns(UserWarning, match="cannot be loaded and is removed"):
        assert model(d) is None
    assert not folder.exists()


def test_the_command_lists_and_clears(cache: Path, capsys: pytest.CaptureFixture) -> None:
    (cache / "abc").mkdir()
    (cache / "abc" / "ready").touch()
    (cache / "broken.job").write_bytes(b"x")
    assert main(["cache"]) == 0
    text = capsys.readouterr().out
    assert "abc" in text
    assert "left over" in text
    assert main(["cache", "--clear"]) == 0
    assert list(cache.iterdir()) == []


def test_packages_are_built_at_the_second_batch_only(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Dynamics] = []

    def build(d: Dynamics) -> None:
        built.append(d)
        compiled._building[key(d)] = None  # type: ignore[assignment]

    monkeypatch.setattr(compiled, "build_in_background", build)
    monkeypatch.setattr(compiled, "_building", {})
    monkeypatch.setattr(compiled, "_PATIENCE", 0.0)
    counts = []
    for _ in range(4):
        assert model(dynamics()) is None
        counts.append(len(built))
    assert counts == [0, 1, 1, 1]


def test_with_few_cores_a_build_waits(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Dynamics] = []
    monkeypatch.setattr(compiled, "build_in_background", built.append)
    monkeypatch.setattr(compiled, "_FEW_CORES", 10**6)
    for _ in range(3):
        model(dynamics())
    assert built == []


def test_without_a_compiler_the_eager_route_works_and_says_so(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(UserWarning, match=r"no C\+\+ compiler"):
        assert model(dynamics()) is None


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 3])
def test_compiled_and_eager_agree(cache: Path, monkeypatch: pytest.MonkeyPatch, lanes: int) -> None:
    system, d = build(3, cells=(6, 2), modes=3), dynamics().condensed()
    compiled.build(compiled.bare(d.topology), compiled.Signature.of(d), key(d))
    motions = []
    for switch in ("0", "1"):
        monkeypatch.setenv("TORCHMBD_COMPILE", switch)
        motions.append(mbd.simulate(system, 0.004, steps=80, sensitivities=True, designs={NAME: ANGLES[:lanes]}))
    assert key(d) in compiled._loaded
    eager, fast = motions
    torch.testing.assert_close(fast.q, eager.q, rtol=0, atol=1e-10)
    assert float((fast.dq_db - eager.dq_db).abs().max()) < 1e-8 * float(eager.dq_db.abs().max())


def sprung(law=None) -> mbd.System:
    """A rigid arm and a flexible plate with springs, an actuator and a load between them."""
    ground, arm, rod = mbd.Ground(), box("arm"), plate("rod", modes=2, position=(0.3, 0.0, 0.0))
    table = mbd.forces.Table(((-2.0, 1.0), (0.0, 0.2), (1.0, -1.0)), damping=0.02)
    forces = [
        mbd.SpringDamper(arm.at(0.1, 0.0, 0.0), rod.at("right"), stiffness=300.0, damping=1.0, rest=0.1),
        mbd.RotationalSpringDamper(arm.at(), rod.at("left"), law=law or table),
        mbd.Force(rod.at("right"), (0.0, 1.0, 0.0)),
    ]
    joints = [mbd.Revolute(ground.at(), arm.at()), mbd.Spherical(arm.at(0.15, 0.0, 0.0), rod.at("left"))]
    return mbd.System([arm, rod], joints, forces, gravity=(0.0, 0.0, -9.81))


def test_a_law_of_the_user_is_never_looked_up_in_the_cache(cache: Path) -> None:
    """Its code is not in the key, so a package could be that of another law."""
    for law, known in ((None, True), (lambda s, rate, t: -s, False)):
        assert compiled._known_laws(sprung(law)().condensed().topology) is known


@pytest.mark.slow
def test_forces_are_compiled(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = sprung()
    designs = {NAME: system.body("rod").laminate.angles.detach() + torch.tensor([[0.0], [0.2]], dtype=torch.float64)}
    d = system.dynamics(designs, tangents=[NAME]).condensed()
    compiled.build(compiled.bare(d.topology), compiled.Signature.of(d), key(d))
    motions = []
    for switch in ("0", "1"):
        monkeypatch.setenv("TORCHMBD_COMPILE", switch)
        motions.append(mbd.simulate(system, 0.01, steps=20, sensitivities=True, designs=designs))
    assert key(d) in compiled._loaded
    eager, fast = motions
    torch.testing.assert_close(fast.q, eager.q, rtol=0, atol=1e-10)
    assert float((fast.dq_db - eager.dq_db).abs().max()) < 1e-8 * float(eager.dq_db.abs().max())
