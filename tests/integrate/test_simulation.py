"""A Simulation is made once: its motions are those of `simulate`, also after its system has changed."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import refused
from torchmbd.examples.slider_crank import build

ANGLES = "rod.laminate.angles"
DESIGNS = torch.tensor([[0.35, -0.87]], dtype=torch.float64)
ENERGY = mbd.Max(mbd.StrainEnergy("rod"))
RATES = {"rod.angular_velocity": [0.0, 0.0, 2.0]}
PHASES = [mbd.Phase(until=0.009), mbd.Phase()]


def numbers(motion: mbd.Trajectory, designs: torch.Tensor) -> list[torch.Tensor]:
    """The motion, and the gradient of a response where it has one."""
    result = [motion.q, motion.v, motion.a, motion.lam]
    if motion.stats["gradients"] != "none":
        result += torch.autograd.grad(ENERGY(motion).sum(), [designs], retain_graph=True)
    return [x.detach() for x in result]


def is_same(simulation: mbd.Simulation, gradients: str, calls: int = 1) -> bool:
    """Whether motions of the simulation are those of `simulate` with its settings, bit for bit."""
    designs = DESIGNS.clone().requires_grad_()
    system, seconds = simulation.system, simulation.seconds
    first = mbd.simulate(system, seconds, designs={ANGLES: designs}, gradients=gradients, **simulation.settings)
    expected = numbers(first, designs)
    for _ in range(calls):
        motion = simulation({ANGLES: designs}, gradients)
        pairs = zip(numbers(motion, designs), expected, strict=True)
        if motion.status != first.status or not all(torch.equal(a, b) for a, b in pairs):
            return False
    return True


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("gradients", "options"),
    [
        ("reverse", {}),
        ("reverse", {"phases": PHASES, "start": RATES}),
        ("none", {"start": "equilibrium"}),
        ("forward", {"phases": PHASES}),
        ("none", {"method": "hht_alpha"}),
        ("none", {"method": "rk4"}),
    ],
)
def test_every_call_is_the_motion_of_simulate(gradients, options):
    simulation = mbd.Simulation(pendulum(damping=1e-4), 0.02, steps=4, backend="eager", **options)
    assert is_same(simulation, gradients, calls=2)  # the first call does not use up what the simulation holds


def moved(system: mbd.System) -> None:
    system.body("rod").velocity.fill_(0.1)


def loaded(system: mbd.System) -> None:
    system.load_state_dict({k: 1.1 * x if k.endswith("thickness") else x for k, x in system.state_dict().items()})


def stabilized(system: mbd.System) -> None:
    system.stabilization = 2e-2


def thicker(system: mbd.System) -> None:
    with torch.no_grad():
        system.get_parameter("rod.laminate.thickness").mul_(1.2)


@pytest.mark.thorough
@pytest.mark.parametrize("start", ["assembled", RATES], ids=["assembled", "numbers"])
def test_a_changed_system_has_the_motion_of_its_present_numbers(start):
    """By another constant rate, another state dict, another time of stabilization, other numbers of a parameter."""
    system = pendulum(damping=1e-4)
    simulation = mbd.Simulation(system, 0.02, steps=2, start=start, backend="eager")
    before = simulation(gradients="none").q
    for change in (moved, loaded, stabilized, thicker):
        change(system)
        assert is_same(simulation, "none"), change.__name__
        assert not torch.equal(simulation(gradients="none").q, before)


def test_tensors_of_a_start_count_as_they_are():
    system, rates = mbd.examples.pendulum(), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    simulation = mbd.Simulation(system, 0.02, steps=4, start={"bob.angular_velocity": rates}, backend="eager")
    before = simulation().v
    rates[2] = 2.0
    assert torch.equal(simulation().v, mbd.simulate(system, 0.02, steps=4, start=simulation.start, backend="eager").v)
    assert not torch.equal(simulation().v, before)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_simulation_that_is_made_without_gradients_has_them_where_it_is_called(mode):
    """By the end of another motion."""
    rates = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    system = mbd.examples.pendulum()
    first = mbd.simulate(system, 0.01, steps=2, start={"bob.angular_velocity": rates}, backend="eager")
    with mode():
        simulation = mbd.Simulation(system, 0.01, steps=2, start=first, backend="eager")
    [slope] = torch.autograd.grad(simulation().q.sum(), [rates], retain_graph=True)
    second = mbd.simulate(system, 0.01, steps=2, start=first, backend="eager")
    assert torch.equal(slope, torch.autograd.grad(second.q.sum(), [rates])[0])
    assert slope.abs().max() > 0.0


def test_topology_is_built_once_for_a_start(monkeypatch):
    """The system that begins at a start is made at the door, not at every call."""
    made = []
    starting = mbd.System.starting
    monkeypatch.setattr(mbd.System, "starting", lambda system, start: made.append(start) or starting(system, start))
    simulation = mbd.Simulation(mbd.examples.pendulum(), 0.02, steps=4, start="equilibrium", backend="eager")
    for steps in (4, 4, 5):
        simulation.with_steps(steps)()
    assert len(made) == 1


def test_other_steps_are_those_of_a_simulation_made_with_them():
    system = mbd.examples.pendulum()
    simulation = mbd.Simulation(system, 0.02, steps=4, backend="eager")
    assert simulation.with_steps(4) is simulation
    assert torch.equal(simulation.with_steps(6)().q, mbd.simulate(system, 0.02, steps=6, backend="eager").q)
    assert simulation.steps == 4
    with refused("steps", 0):
        simulation.with_steps(0)
    longer = simulation.with_arguments(duration=0.04)
    assert torch.equal(longer().q, mbd.simulate(system, 0.04, steps=4, backend="eager").q)


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"steps": 0}, "steps"),
        ({"method": "eulr"}, "method"),
        ({"backend": "gpu"}, "backend"),
        ({"start": "rest"}, "start"),
        ({"phases": [mbd.Phase(until=0.5), mbd.Phase()]}, "phases.until"),
        ({"spectral_radios": 0.8}, "spectral_radios"),
    ],
)
def test_the_constructor_refuses_what_no_motion_has(arguments, path):
    with refused(path):
        mbd.Simulation(mbd.examples.pendulum(), 0.02, **arguments)


def test_a_call_refuses_its_own_arguments():
    simulation = mbd.Simulation(mbd.examples.pendulum(), 0.02, steps=4)
    with refused("parameter", "bob.mess"):
        simulation({"bob.mess": torch.ones(1, dtype=torch.float64)})
    with refused("gradients", "both"):
        simulation(gradients="both")


@pytest.mark.parametrize("again", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"])
def test_a_simulation_can_be_sent_to_another_process(again):
    simulation = mbd.Simulation(mbd.examples.pendulum(), 0.02, steps=4, start="equilibrium", backend="eager")
    assert torch.equal(again(simulation)().q, simulation().q)


def test_a_problem_prepares_its_motions_once(monkeypatch):
    """A start that is an equilibrium has its system, and phases are checked, when the problem is made."""
    made = []
    starting = mbd.System.starting
    monkeypatch.setattr(mbd.System, "starting", lambda system, start: made.append(start) or starting(system, start))
    problem = mbd.Problem(
        mbd.examples.arm(),
        0.01,
        minimize=mbd.Integral(mbd.StrainEnergy("arm")),
        bounds=mbd.deg([-90, 90]),
        motion_start="equilibrium",
        steps=4,
        backend="eager",
    )
    for _ in range(2):
        [evaluation] = problem.evaluate(problem.start[None], False)
        assert evaluation.status == "ok"
    assert len(made) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("phases", PHASES), ("steps", 8), ("duration", 0.1), ("method", "rk4"), ("backend", "native"), ("start", RATES)],
)
def test_arguments_cannot_change(name, value):
    """The motion would be of the former ones, or of these, by the way its gradients are computed."""
    simulation = mbd.Simulation(mbd.examples.pendulum(), 0.02, steps=4, backend="eager", phases=PHASES)
    with refused(name, value):
        setattr(simulation, name, value)
    with pytest.raises(TypeError):
        simulation.phases[0] = mbd.Phase()
    assert simulation.with_arguments(steps=6).phases == tuple(PHASES)
    assert pickle.loads(pickle.dumps(simulation)).steps == copy.copy(simulation).steps == 4


def body_after_a_motion(backend: str) -> weakref.ref:
    """A body of a system whose crank is prescribed; the motion, its multipliers and a gradient were read."""
    system = build(1, cells=(2, 2), modes=1)
    motion = mbd.simulate(system, 1e-3, steps=2, backend=backend)
    (ENERGY(motion).sum() + motion.lam.sum()).backward()
    return weakref.ref(system.body("rod"))


def test_bodies_of_a_system_end_with_it():
    body = body_after_a_motion("eager")
    gc.collect()
    assert body() is None


@pytest.mark.thorough
def test_bodies_of_a_system_of_compiled_code_end_with_it(native):
    body = body_after_a_motion("native")
    gc.collect()
    assert body() is None
