"""The equations of motion against d'Alembert's principle, node by node; the saddle-point matrix against the residual.

Nothing of the inertia invariants is used on the expected side: nodes, lumped masses and mode shapes only.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import (
    CARBON,
    GRAVITY,
    INERTIA,
    box,
    cross_matrix,
    laminate,
    pendulum,
    plate,
    random_state,
    turned,
)
from torchmbd.math.pair import Pair
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.saddle.blocks import Slopes


def system_of(kinds: str) -> mbd.System:
    """Free bodies under gravity with different laminates and numbers of modes, in the order of the letters."""
    bodies = []
    for i, kind in enumerate(kinds):
        if kind == "r":
            bodies.append(box(f"body_{i}"))
        else:
            made_of = laminate((20.0 - 15.0 * i, -50.0, 75.0), 6e-3 + 1e-3 * i, CARBON)
            bodies.append(
                plate(f"body_{i}", modes=3 + i, made_of=made_of, damping=2e-5 * i, reference="corner_left_top")
            )
    return mbd.System(bodies, gravity=GRAVITY)


def parts(T: Topology, x: Tensor, index: int, rotation_rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Translation, rotation and modal part of one body of coordinates or rates [n, 1, 1]."""
    n, y = T.bodies, x[:, 0, 0]
    r = y[: 3 * n].reshape(3, n)[:, index]
    p = y[3 * n : (3 + rotation_rows) * n].reshape(rotation_rows, n)[:, index]
    w = y[(3 + rotation_rows) * n :].reshape(T.modes, T.flexible)
    return r, p, w[: T.mode_counts[index], index] if index < T.flexible else y[:0]


def matrix_of(p: Tensor) -> Tensor:
    e0, e = p[0], p[1:]
    return (2 * e0**2 - 1) * torch.eye(3, dtype=torch.float64) + 2 * (torch.outer(e, e) + e0 * cross_matrix(e))


def nodes_of(body: mbd.FlexibleBody) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Positions, masses, rotary inertias and mode shapes of the nodes."""
    with torch.no_grad():
        mass = body.laminate.mass_per_area * body.matrices.area
        rotary = body.laminate.rotary_inertia_per_area * body.matrices.area
        return body.mesh.nodes - body.origin, mass, rotary, body.structure()["psi"]


def dalembert(T: Topology, body: mbd.FlexibleBody, index: int, q, v, a, gravity: Tensor):
    """Forces, torques and modal forces as sums over the nodes."""
    x, mass, rotary, psi = nodes_of(body)
    _, p, w = parts(T, q, index, 4)
    (_, om, wd), (rdd, omd, wdd) = parts(T, v, index, 3), parts(T, a, index, 3)
    A = matrix_of(p)
    force, torque, modal = torch.zeros(3).double(), torch.zeros(3).double(), torch.zeros_like(w)
    for x_k, m, mu, rows in zip(x, mass, rotary, psi, strict=True):
        t, r = rows[:3], rows[3:]
        b, bd, bdd = x_k + t @ w, t @ wd, t @ wdd
        spin = cross_matrix(om)
        local = A.T @ (rdd - gravity) + cross_matrix(omd) @ b + spin @ spin @ b + 2.0 * spin @ bd + bdd
        angular = omd + r @ wdd + spin @ (r @ wd)
        force += m * (A @ local)
        torque += m * torch.linalg.cross(b, local) + mu * angular
        modal += t.T @ (m * local) + r.T @ (mu * angular)
    K = body.structure()["Kr"].detach()
    return force, torque, modal + K @ w + body.damping.time * K @ wd


@pytest.mark.thorough
@pytest.mark.parametrize("kinds", ["f", "fr", "rff"])
def test_inertia_forces_are_the_sums_over_the_nodes(kinds):
    """A missing Coriolis, centrifugal or gyroscopic term, a mode of the wrong body, padded modes that take part."""
    system = system_of(kinds)
    T = system.topology
    data = {name: x.detach() for name, x in system().dynamics.data.items()}
    q, v, a = random_state(system, seed=4, bend=0.3)
    at = equations.placement(T, data, q, T.prescribed(torch.zeros(())))
    force, torque, modal = (x[..., 0, 0] for x in equations.inertia_forces(T, data, at, v, a))
    gravity = torch.tensor(GRAVITY, dtype=torch.float64)
    for index in range(T.flexible):
        body = system.body(T.names[index])
        for result, expected in zip(
            (force[:, index], torque[:, index], modal[: body.modes, index]),
            dalembert(T, body, index, q, v, a, gravity),
            strict=True,
        ):
            assert_close(result, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("kinds", ["r", "rr", "fr"])
def test_rigid_bodies_obey_newton_and_euler(kinds):
    """About the center of mass, with the inertia that was given: J_c omega' + omega x J_c omega."""
    system = system_of(kinds)
    T = system.topology
    data = {name: x.detach() for name, x in system().dynamics.data.items()}
    q, v, a = random_state(system, seed=9)
    force, torque, _ = (
        x[..., 0, 0]
        for x in equations.inertia_forces(T, data, equations.placement(T, data, q, T.prescribed(torch.zeros(()))), v, a)
    )
    center, mass = torch.tensor([0.03, -0.02, 0.04], dtype=torch.float64), 0.7
    for index in range(T.flexible, T.bodies):
        _, p, _ = parts(T, q, index, 4)
        (_, om, _), (rdd, omd, _) = parts(T, v, index, 3), parts(T, a, index, 3)
        A, spin = matrix_of(p), cross_matrix(om)
        pull = mass * (rdd - torch.tensor(GRAVITY).double() + A @ (cross_matrix(omd) + spin @ spin) @ center)
        expected = INERTIA @ omd + spin @ INERTIA @ om + torch.linalg.cross(center, A.T @ pull)
        assert_close(force[:, index], pull, rtol=1e-13, atol=1e-13)
        assert_close(torque[:, index], expected, rtol=1e-13, atol=1e-13)


def mechanisms() -> dict[str, mbd.System]:
    """Mechanisms with every kind of body and primitive."""
    rigid = mbd.System([box("first"), box("second")], gravity=GRAVITY)
    return {"mixed": mixed(), "stiffened": mixed(True), "rigid": rigid, "pendulum": pendulum()}


def mixed(stiffening: bool = False) -> mbd.System:
    """All kinds; stiffening: of one of the two flexible bodies."""
    ground, first, second = (
        mbd.Ground(),
        box("first"),
        box("second", position=(0.4, 0.1, 0.2), axes=turned(0.3, 1, -0.5)),
    )
    placed: dict = {"position": (-0.2, 0.3, 0.1), "axes": turned(-0.4, 0.2, 0.8), "stiffening": stiffening}
    link = plate("link", modes=4, damping=1e-4, **placed)
    other = plate(
        "other", modes=2, made_of=laminate((10.0, 80.0)), position=(0.1, -0.3, 0.2), axes=turned(0.6, -0.2, 0.3)
    )
    joints = [
        mbd.Revolute(ground.at(0.1, 0.2, 0.3, axes=turned(0.5, 0.1, 0.2)), first.at(0.1, 0, 0), axis="y"),
        mbd.Cylindrical(link.at("left"), first.at(0.2, 0.1, 0), axis="x"),
        mbd.DistanceJoint(link.at("right"), second.at(0.0, 0.1, 0.1), length=0.3),
        mbd.Universal(other.at("left"), link.at("corner_left_top"), axes="zx"),
        mbd.Drive(ground, second, axis="x", speed=7.0),
        mbd.Spherical(second.at(), ground.at(0.4, 0.1, 0.2)),
    ]
    return mbd.System([first, link, second, other], joints)


@pytest.fixture(scope="module", params=["mixed", "stiffened", "rigid", "pendulum"])
def linearized(request):
    """A mechanism at a general state, its data, and a residual of accelerations and multipliers [n, 1, lanes]."""
    system = mechanisms()[request.param]
    T, data = system.topology, {name: x.detach() for name, x in system().dynamics.data.items()}
    q, v, a = random_state(system, seed=13, bend=0.05)
    t = torch.tensor(0.3, dtype=torch.float64)
    lam = torch.randn(T.rows, 1, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return system, data, t, q, v, a, lam


def test_saddle_matrix_is_the_derivative_of_the_index_1_residual(linearized):
    """[M Phi_q'; Phi_q 0]: every column is the change of the residual by one acceleration or multiplier (it is linear)."""
    system, data, t, q, v, a, lam = linearized
    T, dynamics = system.topology, system.dynamics()
    at = equations.placement(T, data, q, T.prescribed(t))
    n = T.n_v + T.rows
    x = torch.cat([a, lam])
    moved = x + torch.eye(n, dtype=torch.float64)[:, None]
    both = torch.cat([x, moved], -1)
    wide = {name: y.expand(*y.shape[:-1], n + 1) for name, y in data.items()}
    at_all = equations.placement(T, wide, q.expand(-1, 1, n + 1), T.prescribed(t))
    unknowns, alpha = (v.expand(-1, 1, n + 1), both[: T.n_v], both[T.n_v :]), 1.0 / dynamics.stabilization
    R = equations.stabilized_residual(T, wide, at_all, *unknowns, T.law_jets(t), alpha)[:, 0]
    columns = R[:, 1:] - R[:, :1]
    scale = float(R.abs().max())
    assert_close(dynamics.saddle.matrix(data, at)[0], columns, rtol=1e-12, atol=1e-14 * scale)


def test_iteration_matrix_is_the_derivative_of_the_forces(linearized):
    """Stiffness, damping and gyroscopic terms: what an implicit integrator iterates with.

    A gyroscopic term that is left out slows the iteration down, and nothing else would tell.
    """
    system, data, t, q, v, _, lam = linearized
    T = system.topology
    drives = T.prescribed(t)
    at = equations.placement(T, data, q, drives)
    bare, quiet = system.dynamics().saddle.matrix(data, at)[0], torch.zeros_like(lam)
    n_v = T.n_v

    def forces(v: Tensor) -> Tensor:
        return equations.dynamic_residual(T, data, at, v, torch.zeros_like(v), quiet)[:, 0, 0]

    D = torch.func.jacfwd(forces)(v)[:, :, 0, 0]
    result = system.dynamics().saddle.matrix(data, at, Slopes(0.0, 1.0, v))[0] - bare
    scale = float(D.abs().max())
    assert_close(result[:n_v, :n_v], D, rtol=0, atol=1e-12 * scale)
    assert_close(result[n_v:], torch.zeros_like(result[n_v:]))

    w = 7 * T.bodies
    K = torch.func.jacfwd(lambda x: _spring(T, data, q, x, v, quiet, drives))(q[w:])[:, :, 0, 0]
    result = system.dynamics().saddle.matrix(data, at, Slopes(1.0, 0.0))[0] - bare
    assert_close(
        result[6 * T.bodies : n_v, 6 * T.bodies : n_v],
        K,
        rtol=1e-12,
        atol=1e-12 * float(K.abs().amax() if K.numel() else 0),
    )


def _spring(T: Topology, data, q, w, v, quiet, drives) -> Tensor:
    """Modal forces at rest without gravity."""
    still = {name: x for name, x in data.items() if name != "gravity"}
    at = equations.placement(T, still, torch.cat([q[: 7 * T.bodies], w]), drives)
    zero = torch.zeros_like(v)
    return equations.dynamic_residual(T, still, at, zero, zero, quiet)[6 * T.bodies :, 0, 0]


@pytest.mark.parametrize("linearized", ["mixed", "stiffened", "pendulum"], indirect=True)
def test_geometric_stiffness_is_the_derivative_of_the_constraint_forces(linearized):
    """Forces on the attached vectors held in ground axes while the bodies turn and bend under them."""
    system, data, t, q, _, _, lam = linearized
    T = system.topology
    drives = T.prescribed(t)
    at = equations.placement(T, data, q, drives)
    held = equations.force_on_vectors(T, at, lam)

    def forces(step: Tensor) -> Tensor:
        moved = equations.placement(T, data, equations.advance(T, q, step), drives)
        return torch.cat([x.flatten() for x in equations.generalized_forces(T, data, moved, held)])

    h, n_v = 1e-6, T.n_v
    steps = h * torch.eye(n_v, dtype=torch.float64)[..., None, None]
    expected = torch.stack([(forces(step) - forces(-step)) / (2 * h) for step in steps], 1)
    matrix = system.dynamics().saddle.matrix
    result = matrix(data, at, Slopes(1.0, lam=lam))[0] - matrix(data, at, Slopes(1.0))[0]
    assert_close(result[:n_v, :n_v], expected, rtol=0, atol=1e-8 * float(expected.abs().max()))
    assert not result[n_v:].any()


@pytest.mark.parametrize("linearized", ["mixed", "stiffened", "pendulum"], indirect=True)
def test_inertial_stiffness_is_the_derivative_of_the_inertia_forces_by_the_coordinates(linearized):
    system, data, t, q, v, a, _ = linearized
    T = system.topology
    drives = T.prescribed(t)

    def forces(step: Tensor) -> Tensor:
        moved = equations.placement(T, data, equations.advance(T, q, step), drives)
        return torch.cat([x.flatten() for x in equations.inertia_forces(T, data, moved, v, a)])

    h, n_v = 1e-6, T.n_v
    steps = h * torch.eye(n_v, dtype=torch.float64)[..., None, None]
    expected = torch.stack([(forces(step) - forces(-step)) / (2 * h) for step in steps], 1)
    matrix, at = system.dynamics().saddle.matrix, equations.placement(T, data, q, drives)
    result = matrix(data, at, Slopes(1.0, 0.0, v, a))[0] - matrix(data, at)[0]
    assert_close(result[:n_v, :n_v], expected, rtol=0, atol=1e-8 * float(expected.abs().max()))
    assert not result[n_v:].any()


def test_residual_carries_design_tangents(linearized):
    """The whole residual on pairs against torch.func.jvp, all arguments moving: no term drops its tangent."""
    system, data, t, q, v, a, lam = linearized
    T, dynamics = system.topology, system.dynamics()
    make = torch.Generator().manual_seed(3)
    arguments = {**data, "q": q, "v": v, "a": a, "lam": lam}
    moves = {
        name: torch.randn(x.shape, generator=make, dtype=torch.float64)
        * (x.abs().amax().clamp_min(1e-3) if x.numel() else 1)
        for name, x in arguments.items()
    }

    def residual(x):
        parts, alpha = {name: x[name] for name in data}, 1.0 / dynamics.stabilization
        at = equations.placement(T, parts, x["q"], T.prescribed(t))
        return equations.stabilized_residual(T, parts, at, x["v"], x["a"], x["lam"], T.law_jets(t), alpha)

    value, slope = torch.func.jvp(residual, (arguments,), (moves,))
    result = residual({name: Pair.of(x, moves[name]) for name, x in arguments.items()})
    assert_close(result.value, value, rtol=1e-13, atol=1e-13 * float(value.abs().max()))
    assert_close(result.tangent, slope, rtol=0, atol=1e-12 * float(slope.abs().max()))


def test_coordinate_rates_are_those_of_advance(linearized):
    """q' = d/dh advance(q, h v), and |p| is pulled back to one."""
    system, _, _, q, v, _, _ = linearized
    T, h = system.topology, 1e-5
    slope = (equations.advance(T, q, h * v) - equations.advance(T, q, -h * v)) / (2 * h)
    assert_close(equations.coordinate_rates(T, q, v), slope, rtol=1e-8, atol=1e-8)
    long = q.clone()
    long[3 * T.bodies : 7 * T.bodies] *= 1.01
    p = slice(3 * T.bodies, 7 * T.bodies)
    growth = (long[p] * equations.coordinate_rates(T, long, v)[p]).sum()
    assert float(growth) < -0.1 * T.bodies
