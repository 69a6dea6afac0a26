"""Bodies that were reduced elsewhere: a round trip changes no digit; other coordinates change no motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import finished, laminate
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.multibody.bodies.reduced_structure import SHAPES


@pytest.fixture(scope="module")
def plate():
    mesh = mbd.mesh.rectangle(length=0.4, width=0.05, cells=(4, 1))
    return mbd.FlexibleBody.plate("arm", mesh, laminate((30.0, -50.0)), modes=3, reference="left_edge")


@pytest.fixture(scope="module")
def made(plate):
    return {key: x.detach() for key, x in plate.structure().items()}


def numbers(made):
    return {key: made[key] for key in SHAPES}


def swing(body) -> torch.Tensor:
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at(0), axis="y")
    motion = mbd.simulate(mbd.System([body], [hinge], gravity=(0, 0, -9.81)), 0.1, steps=50, gradients="none")
    return finished(motion).body("arm").nodes[0, :, -1]


def test_a_round_trip_changes_no_digit(plate, made, tmp_path):
    path = plate.save_reduced(tmp_path / "arm.npz")
    body = mbd.FlexibleBody.from_reduced("arm", path, position=(0.1, 0.0, 0.0))
    result = body.structure()
    for key, x in made.items():
        assert torch.equal(result[key], x), key
    assert body.mesh.node_sets == plate.mesh.node_sets


@pytest.mark.thorough
def test_the_motion_is_the_same(plate, tmp_path):
    body = mbd.FlexibleBody.from_reduced("arm", plate.save_reduced(tmp_path / "arm.npz"))
    assert torch.equal(swing(body), swing(plate))


@pytest.mark.thorough
def test_other_coordinates_are_the_same_body(plate, made):
    """Modes mixed by a matrix A: Kr -> A' Kr A, and likewise for the rest."""
    A = torch.tensor(np.random.default_rng(2).normal(size=(plate.modes,) * 2))
    mixed = numbers(made)
    mixed |= {key: mixed[key] @ A for key in ("S1", "C0", "R1")}
    mixed |= {key: A.T @ mixed[key] @ A for key in ("C1", "R2")}
    nodes = plate.mesh.nodes - plate.origin
    Kr = A.T @ made["Kr"] @ A
    body = mbd.FlexibleBody.from_reduced("arm", nodes, made["psi"] @ A, 0.5 * (Kr + Kr.T), mixed)
    assert_close(swing(body), swing(plate), rtol=0.0, atol=1e-10)


@pytest.mark.thorough
def test_quadratic_stiffness_is_kept_and_turns_with_the_coordinates(plate, made, tmp_path):
    """In normalized coordinates as in others, and in the file."""
    rows = [torch.tensor(x, dtype=torch.float64) for x in ((1.0, 0.5, -0.3), (0.2, 1.0, 0.4))]
    cubic = sum(3e7 * torch.einsum("i,j,k->ijk", x, x, x) for x in rows)
    nodes, own = plate.mesh.nodes - plate.origin, numbers(made)
    A = torch.diag(torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64))
    scaled = own | {key: own[key] @ A for key in ("S1", "C0", "R1")} | {k: A @ own[k] @ A for k in ("C1", "R2")}
    plain = mbd.FlexibleBody.from_reduced("arm", nodes, made["psi"], made["Kr"], own, K2=cubic)
    other = mbd.FlexibleBody.from_reduced(
        "arm", nodes, made["psi"] @ A, A @ made["Kr"] @ A, scaled, K2=torch.einsum("abc,ai,bj,ck->ijk", cubic, A, A, A)
    )
    read = mbd.FlexibleBody.from_reduced("arm", plain.save_reduced(tmp_path / "arm.npz"))
    linear, bent = swing(plate), swing(plain)
    assert float((bent - linear).abs().max()) > 1e-6
    assert_close(swing(other), bent, rtol=0.0, atol=1e-10)
    assert torch.equal(swing(read), bent)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [6e7, -6e7])
def test_a_static_deflection_with_quadratic_stiffness(plate, made, size):
    """Kr w + 1/2 w' K2 w = F by an iteration of one's own, and the energy 1/2 Kr ww + 1/6 K2 www of that."""
    row = torch.tensor([1.0, 0.5, -0.3], dtype=torch.float64)
    cubic = size * torch.einsum("i,j,k->ijk", row, row, row)
    nodes = plate.mesh.nodes - plate.origin
    own = mbd.FlexibleBody.from_reduced("arm", nodes, made["psi"], made["Kr"], numbers(made), K2=cubic)
    Kr, load = made["Kr"], made["psi"][-1, 2] * 0.3
    clamp = mbd.Fixed(mbd.Ground().at(*nodes[0].tolist()), own.at(0))
    force = mbd.Force(own.at(len(nodes) - 1), (0.0, 0.0, 0.3))
    w = torch.zeros_like(load)
    for _ in range(20):
        w = w - torch.linalg.solve(Kr + cubic @ w, Kr @ w + 0.5 * cubic @ w @ w - load)
    linear = torch.linalg.solve(Kr, load)
    assert float((w - linear).norm()) > 0.02 * float(linear.norm())
    rest = mbd.equilibrium(mbd.System([own], [clamp], [force]))
    assert_close(rest.body("arm").w[0, 0], w, rtol=1e-8, atol=0)
    energy = 0.5 * w @ Kr @ w + cubic @ w @ w @ w / 6.0
    assert_close(mbd.Max(mbd.StrainEnergy("arm"))(rest)[0], energy, rtol=1e-8, atol=0)
    assert_close(rest.energies.strain[0, 0], energy, rtol=1e-8, atol=0)


def test_inertia_may_stand_for_its_matrix(plate, made):
    own = numbers(made)
    P0 = own.pop("P0")
    own["J"] = P0.trace() * torch.eye(3, dtype=torch.float64) - P0
    body = mbd.FlexibleBody.from_reduced("arm", plate.mesh.nodes, made["psi"], made["Kr"], own)
    assert_close(body.structure()["P0"], P0, rtol=1e-12, atol=1e-15)


WRONG = {
    "lacks": (lambda x: {"invariants": {k: v for k, v in x.items() if k != "C0"}}, "lack 'C0'"),
    "unknown": (lambda x: {"invariants": x | {"C2": 1.0}}, "'C2'"),
    "shape": (lambda x: {"invariants": x | {"S1": torch.zeros(3, 7)}}, r"arm.S1 has shape \(3, 7\)"),
    "negative": (
        lambda x: {"invariants": x | {"mass": -1.0}},
        "arm.mass has the eigenvalue -1: must be positive definite",
    ),
    "Kr": (lambda x: {"Kr": -torch.eye(3)}, "arm.Kr has the eigenvalue -1: must be positive definite"),
    "Kr's shape": (lambda x: {"Kr": torch.eye(2)}, r"arm.Kr has shape \(2, 2\)"),
    "K2's shape": (lambda x: {"K2": torch.zeros(3, 3)}, r"arm.K2 has shape \(3, 3\)"),
    "K2": (lambda x: {"K2": torch.arange(27.0).reshape(3, 3, 3)}, "arm.K2 is not symmetric"),
    "modes": (lambda x: {"modes": torch.zeros(3, 6, 2)}, r"arm.modes have shape \(3, 6, 2\)"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_body_is_refused(plate, made, case):
    change, words = WRONG[case]
    own = {"nodes": plate.mesh.nodes, "modes": made["psi"], "Kr": made["Kr"], "invariants": numbers(made)}
    with pytest.raises(InputError, match=words):
        mbd.FlexibleBody.from_reduced("arm", **own | change(numbers(made)))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"\x93NUMPY\x01\x00"])
def test_files_of_another_kind_are_refused(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with refused("x.npz"):
        mbd.FlexibleBody.from_reduced("arm", tmp_path / "x.npz")
    with refused("arm.nodes"):
        mbd.FlexibleBody.from_reduced("arm", tmp_path / "y.npz")


@pytest.mark.thorough
def test_ply_stress_names_what_is_missing(plate, tmp_path):
    body = mbd.FlexibleBody.from_reduced("arm", plate.save_reduced(tmp_path / "arm.npz"))
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at(0), axis="y")
    motion = mbd.simulate(mbd.System([body], [hinge]), 0.01, steps=5, gradients="none")
    assert torch.isfinite(mbd.Max(mbd.StrainEnergy("arm"))(motion)).all()
    with refused("body", "arm"):
        mbd.Max(mbd.PlyStress("arm", "11"))(motion)
    with refused("arm"):
        body.save_matrices(tmp_path / "m")


def test_arguments_that_would_be_ignored_are_refused(plate, made, tmp_path):
    """A file has modes and node sets, and so has a mesh."""
    path = plate.save_reduced(tmp_path / "arm.npz")
    with refused("arm.modes"):
        mbd.FlexibleBody.from_reduced("arm", path, modes=2, node_sets={"tip": [0]})
    with refused("arm.node_sets", {"tip": [0]}):
        mbd.FlexibleBody.from_reduced("arm", plate.mesh, made["psi"], made["Kr"], numbers(made), node_sets={"tip": [0]})
    M, K = plate.mass_and_stiffness()
    with refused("arm.node_sets", {"tip": [0]}):
        mbd.FlexibleBody.from_matrices("arm", M, K, nodes=plate.mesh, node_sets={"tip": [0]})
