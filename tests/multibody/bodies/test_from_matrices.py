"""Bodies from mass and stiffness matrices: as built-in ones, with derivatives, refused where they are no free body."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import finished
from tests.refused import refused, warned
from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine

pytestmark = pytest.mark.usefixtures("compiled")

NODES = torch.linspace(0.0, 0.6, 7, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
SETS = {"start": [0], "end": [6], "middle": [3]}


def beam(**given) -> mbd.FlexibleBody:
    section = mbd.sections.box(0.02, 0.03, CARBON, mbd.deg([30.0, -50.0]), thickness=1e-3)
    return mbd.FlexibleBody.beam(
        "arm", BeamLine.straight(0.6, 6), section, **{"modes": 4, "reference": "start"} | given
    )


@pytest.fixture(scope="module")
def built():
    return beam()


@pytest.fixture(scope="module")
def numbers(built):
    return built.mass_and_stiffness()


def given(numbers, **other) -> mbd.FlexibleBody:
    M, K = numbers
    own = {"modes": 4, "reference": "start", "node_sets": SETS} | other
    return mbd.FlexibleBody.from_matrices("arm", M, K, NODES, **own)


def swing(body: mbd.FlexibleBody) -> torch.Tensor:
    """Path of the tip of a pendulum under gravity [time, 3]."""
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("start"), axis="y")
    motion = mbd.simulate(mbd.System([body], [hinge], gravity=(0, 0, -9.81)), 0.005, steps=100, gradients="none")
    return finished(motion).body("arm").nodes[0, :, 6]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["vibration", "craig-bampton"])
def test_a_beam_is_the_built_in_one(numbers, kind):
    other = {"reduction": kind, "interface": "end" if kind == "craig-bampton" else ()}
    one, two = beam(**other), given(numbers, **other)
    assert two.modes == one.modes
    a, b = one.structure(), two.structure()
    for key in ("mass", "S0", "S1", "C0", "C1", "Kr", "psi"):
        scale = float(a[key].detach().abs().max())
        assert_close(b[key], a[key].detach(), rtol=1e-9, atol=1e-10 * scale, msg=lambda m, k=key: f"{k}: {m}")
    assert_close(swing(two), swing(one), rtol=0.0, atol=1e-9)


def test_arrays_and_sparse_matrices_make_the_same_body(numbers):
    want = given(numbers).structure()
    for M, K in ([x.toarray() for x in numbers], [scipy.sparse.csc_matrix(x) for x in numbers]):
        result = given((M, K)).structure()
        for key in ("mass", "S0", "P0", "S1", "C0", "C1", "Kr", "psi"):
            assert_close(result[key], want[key], rtol=1e-9, atol=1e-9 * float(want[key].abs().max()))


def test_given_modes_span_the_same_motion(built, numbers):
    """The modes of the body, mixed: the same reduced body."""
    psi = given(numbers).structure()["psi"].flatten(0, 1)
    mixed = psi @ torch.tensor(np.random.default_rng(3).normal(size=(psi.shape[1],) * 2))
    result = given(numbers, modes=mixed)
    assert result.modes == psi.shape[1]
    assert_close(result.structure()["Kr"], given(numbers).structure()["Kr"], rtol=1e-8, atol=1e-3)


@pytest.mark.parametrize("nodes", [{1: (0, 0, 0), 2: (1, 0)}, {1: "abc"}, {1: (0, 0, 0), "a": (1, 0, 0)}])
def test_labels_with_places_that_are_none(numbers, nodes):
    with refused("arm.nodes"):
        mbd.FlexibleBody.from_matrices("arm", *numbers, nodes)


def energy(body: mbd.FlexibleBody) -> torch.Tensor:
    result = body.structure()
    load = result["psi"][6, 2]  # a force at the tip
    return load @ torch.linalg.solve(result["Kr"], load) + result["mass"] * result["S1"].square().sum()


def richardson(f, x: float, h: float) -> float:
    def slope(h):
        return (f(x + h) - f(x - h)) / (2.0 * h)

    return (4.0 * slope(h / 2.0) - slope(h)) / 3.0


@pytest.mark.thorough
def test_derivatives_that_the_user_gives(numbers):
    M, K = numbers
    body = given(numbers, derivatives={"height": (0.03, 2.0 * M, 5.0 * K), "density": (1.0, M, None)})
    assert [name for name, _ in body.named_parameters()] == ["model.height", "model.density"]
    energy(body).backward()
    for key, base in (("height", 0.03), ("density", 1.0)):
        own = body.get_parameter(f"model.{key}")
        result = float(own.grad)

        def f(x, own=own):
            with torch.no_grad():
                own.fill_(x)
                return float(energy(body))

        assert result == pytest.approx(richardson(f, base, 2e-2 * base), rel=1e-6)
        f(base)


class Stiffened(torch.nn.Module):
    """M, and K with a factor on each half of the beam, from the numbers of two assemblies."""

    def __init__(self, M, K):
        super().__init__()
        self.M, self.K = (torch.tensor(x.toarray()) for x in (M, K))
        self.factor = torch.nn.Parameter(torch.tensor(1.2, dtype=torch.float64))

    def forward(self):
        return self.M * self.factor**0.5, self.K * self.factor**3


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["vibration", "craig-bampton"])
def test_a_torch_module_makes_the_matrices(numbers, kind):
    own = {"modes": 3, "reference": "start", "node_sets": SETS, "reduction": kind}
    own["interface"] = "end" if kind == "craig-bampton" else ()
    body = mbd.FlexibleBody.from_matrices("arm", Stiffened(*numbers), nodes=NODES, **own)
    assert [name for name, _ in body.named_parameters()] == ["model.factor"]
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("start"), axis="y")
    system = mbd.System([body], [hinge], gravity=(0, 0, -9.81))

    def run(gradients):
        motion = mbd.simulate(system, 0.002, steps=40, gradients=gradients)
        return mbd.Integral(mbd.StrainEnergy("arm"))(motion).sum()

    run("reverse").backward()
    factor = body.get_parameter("model.factor")
    result = float(factor.grad)

    def f(x):
        with torch.no_grad():
            factor.fill_(x)
        return float(run("none"))

    assert result == pytest.approx(richardson(f, 1.2, 2e-3), rel=1e-6)


@pytest.mark.thorough
def test_a_function_makes_the_matrices_for_many_designs(numbers):
    M, K = (torch.tensor(x.toarray()) for x in numbers)
    body = mbd.FlexibleBody.from_matrices(
        "arm",
        lambda factor: (M, factor * K),
        nodes=NODES,
        parameters={"factor": 2.0},
        modes=3,
        reference=0,
        node_sets=SETS,
    )
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("start"), axis="y")
    system = mbd.System([body], [hinge], gravity=(0, 0, -9.81))
    E = torch.tensor([1.0, 4.0], dtype=torch.float64)
    both = mbd.simulate(system, 0.002, steps=40, designs={"arm.model.factor": E}, gradients="none").q
    for k in range(2):
        one = mbd.simulate(system, 0.002, steps=40, designs={"arm.model.factor": E[k : k + 1]}, gradients="none").q
        assert_close(both[k], one[0], rtol=1e-9, atol=1e-12)


def test_solids_of_three_freedoms():
    """A cube of springs, three freedoms a node, no reference: six freedoms of three nodes hold it, and frames turn."""
    x = torch.tensor([[i, j, k] for i in (0.0, 0.1) for j in (0.0, 0.1) for k in (0.0, 0.1)], dtype=torch.float64)
    K = np.zeros((24, 24))
    for a in range(8):
        for b in range(a):
            d = (x[a] - x[b]).numpy()
            n = np.concatenate([d, -d]) / np.linalg.norm(d)
            rows = [*range(3 * a, 3 * a + 3), *range(3 * b, 3 * b + 3)]
            K[np.ix_(rows, rows)] += 1e6 * np.outer(n, n)
    M = np.eye(24) * 0.1
    body = mbd.FlexibleBody.from_matrices("cube", M, K, x, modes=18)
    made = body.structure()
    frame = made["Kr"]
    want = np.sort(np.linalg.eigvalsh(K))[6:] / 0.1
    # 18 deformations, all of them: free frequencies are those of the pencil whose rigid motions are eliminated
    S = torch.cat([made["S1"], torch.einsum("ikj,ija->ka", eps(), made["C0"])])
    assert float(made["mass"]) == pytest.approx(0.8)
    assert frame.shape == (18, 18)
    J = inertia(made)
    rigid = torch.zeros(6, 6, dtype=torch.float64)
    rigid[:3, :3], rigid[3:, 3:] = 0.8 * torch.eye(3, dtype=torch.float64), J
    rigid[:3, 3:] = -cross(made["S0"])
    rigid[3:, :3] = rigid[:3, 3:].T
    mass = torch.eye(18, dtype=torch.float64) - S.T @ torch.linalg.solve(rigid, S)
    result = scipy.linalg.eigh(frame.numpy(), 0.5 * (mass + mass.T).numpy(), eigvals_only=True)
    np.testing.assert_allclose(result, want, rtol=1e-9)
    assert float(made["psi"][:, 3:].abs().max()) > 0.0


def eps():
    from torchmbd.fem.reduction.mass_invariants import epsilon

    return epsilon()


def cross(s):
    return torch.einsum("ikj,k->ij", eps(), s)


def inertia(made):
    return made["P0"].trace() * torch.eye(3, dtype=torch.float64) - made["P0"]


def _changed(A, i, j, value):
    A = A.tolil(copy=True)
    A[i, j] += value
    return scipy.sparse.csr_array(A)


WRONG = {
    "not symmetric": (
        lambda M, K: {"K": _changed(K, 3, 9, 1e3)},
        r"arm.K has .* between node 0 rx and node 1 rx, .*: must be symmetric",
    ),
    "one half": (
        lambda M, K: {"K": scipy.sparse.csr_array(scipy.sparse.triu(K))},
        r"arm.K has .* in the transposed entry: must be symmetric",
    ),
    "held": (lambda M, K: {"K": _changed(K, 0, 0, 1e9)}, r"arm.K resists a rigid translation x"),
    "negative": (
        lambda M, K: {"K": -1.0 * K},
        r"arm.K has .* at node 1 x .*: must have mass and stiffness at every degree of freedom",
    ),
    "no mass": (lambda M, K: {"M": 0.0 * M}, r"arm.M has the masses"),
    "a size": (lambda M, K: {"K": K[:-6, :-6]}, r"shapes \(42, 42\), \(36, 36\): must have 42 rows"),
    "nodes": (lambda M, K: {"nodes": NODES[:-1]}, r"42 rows for 6 nodes: must have 18 or 36, or `freedoms`"),
    "K": (lambda M, K: {"K": None}, r"arm.K is None"),
    "not finite": (lambda M, K: {"K": _changed(K, 2, 2, np.nan)}, r"not finite"),
    "words": (
        lambda M, K: {"K": "nowhere.mtx"},
        r"arm.K = 'nowhere.mtx': must be numbers, such as mbd.io.read_matrix",
    ),
    "modes": (lambda M, K: {"modes": 99}, r"arm.modes = 99: must be a whole number up to 36"),
    "shapes": (
        lambda M, K: {"modes": np.eye(5)},
        r"arm.modes have shape \(5, 5\): must .* shapes? \[42, m\]",
    ),
    "reference": (lambda M, K: {"reference": "left"}, r"'left'"),
    "reduction": (lambda M, K: {"reduction": "guyan"}, r"arm.reduction"),
    "interface": (lambda M, K: {"interface": "start"}, r"arm.interface has node 0"),
    "derivative": (
        lambda M, K: {"derivatives": {"E": (1.0, M)}},
        r"(?s)derivatives of 'arm': 'E'.*\(value, dM, dK\)",
    ),
    "a name": (
        lambda M, K: {"derivatives": {"a b": (1.0, M, K)}},
        r"arm.derivatives has the name 'a b': must have Python identifiers as names",
    ),
    "freedoms": (lambda M, K: {"freedoms": 5}, r"arm.freedoms = 5: must be 3, 6, or"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_body_is_refused(numbers, case):
    M, K = numbers
    change, words = WRONG[case]
    own = {"M": M, "K": K, "nodes": NODES, "modes": 4, "reference": "start", "node_sets": SETS} | change(M, K)
    with pytest.raises(InputError, match=words):
        mbd.FlexibleBody.from_matrices("arm", **own)


def test_units_are_questioned(numbers):
    """The same body in mm, t, s, N: accepted as a mechanical system, 600 m long."""
    S = scipy.sparse.diags_array(np.tile([10.0**-1.5] * 3 + [10.0**1.5] * 3, 7))
    M, K = (S @ A @ S for A in numbers)
    with warned("body 'arm'", "600 m"):
        mbd.FlexibleBody.from_matrices("arm", M, K, 1e3 * NODES, modes=4, reference=0, node_sets=SETS)
