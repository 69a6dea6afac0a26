"""The system: its arguments, its order of unknowns, batches of designs, and the dynamics that it returns."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, laminate, pendulum, plate, random_state, tensor
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.math.pair import Pair
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.joints.joint import Equation, Joint


@pytest.mark.thorough
def test_unknowns_stand_where_the_topology_says():
    """r by component, then p, then w by mode; flexible bodies first, whatever order they were given in."""
    rigid = box("rigid", position=(1.0, 2.0, 3.0), velocity=(0.1, 0.2, 0.3), angular_velocity=(4.0, 5.0, 6.0))
    system = mbd.System([rigid, plate("few", modes=1), plate("many", modes=3)])
    T = system.topology
    assert T.names == ("few", "many", "rigid")
    assert (T.n_q, T.n_v, T.rows) == (7 * 3 + 3 * 2, 6 * 3 + 3 * 2, 0)
    z = system().initial_state()[0]
    assert z[T.r_slice(2)].tolist() == [1.0, 2.0, 3.0]
    assert z[T.p_slice(2)].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert z[T.n_q :][[2, 5, 8]].tolist() == [0.1, 0.2, 0.3]
    assert z[T.n_q :][[11, 14, 17]].tolist() == [4.0, 5.0, 6.0]
    assert T.w_slice(0) == [21]
    assert T.w_slice(1) == [22, 24, 26]


@pytest.mark.thorough
def test_padded_modes_never_move():
    """A body with fewer modes than another is padded: its padding must stay at rest whatever the rest does."""
    system = mbd.System(
        [plate("few", modes=1, angular_velocity=(3.0, 20.0, 1.0)), plate("many", modes=4)], gravity=(0, 0, -9)
    )
    T, dynamics = system.topology, system()
    z = dynamics.initial_state()
    with torch.no_grad():
        dz = dynamics(0.0, z)[0]
    w = dz[T.n_q + 6 * T.bodies :].reshape(T.modes, T.flexible)
    assert not w[1:, 0].any()
    assert w[0, 0] != 0


@pytest.mark.thorough
def test_lanes_of_a_batch_are_the_designs_one_by_one():
    system = pendulum()
    angles = mbd.deg([[20.0, -50.0], [0.0, 70.0], [-33.0, 12.0]])
    batch = system.dynamics({"rod.laminate.angles": angles})
    assert batch.lanes == 3
    q, v, _ = random_state(system, seed=2)
    z = torch.cat([q, v])[:, 0].T.expand(3, -1)
    both = batch(0.0, z)
    for lane in range(3):
        alone = system.dynamics({"rod.laminate.angles": angles[lane : lane + 1]})
        # Modes of a batch may be rotated or mirrored among themselves: compare what does not depend on them.
        T = system.topology
        rigid = [*range(T.n_q), *range(T.n_q, T.n_q + 6 * T.bodies)]
        picked = batch.select_lanes([lane])
        assert_close(picked(0.0, z[:1]), both[lane : lane + 1], rtol=1e-12, atol=1e-12)
        still = z[:1].clone()
        still[:, 7 * T.bodies : T.n_q] = 0.0
        still[:, T.n_q + 6 * T.bodies :] = 0.0
        assert_close(picked(0.0, still)[:, rigid], alone(0.0, still)[:, rigid], rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_a_state_may_have_lanes_or_none():
    dynamics = pendulum()()
    z = dynamics.initial_state().detach()
    assert_close(dynamics(0.0, z[0]), dynamics(torch.zeros(()), z)[0])
    with refused("z"):
        dynamics(0.0, z[:, :5])


@pytest.mark.thorough
def test_tangents_of_the_data_are_those_of_jacfwd():
    """One linearization of the structure stage for all variables of two bodies; order of names, flattened."""
    system = mbd.System([plate("one"), plate("two", made_of=laminate((10.0, 80.0)))])
    names = ["two.laminate.angles", "one.laminate.angles"]
    own = {name: dict(system.named_parameters())[name].detach()[None] for name in names}
    data = system.dynamics(own, tangents=names).data
    h = 1e-6
    variables = [(name, i) for name in names for i in range(own[name].shape[1])]
    for k, (name, i) in enumerate(variables):
        moved = [own | {name: own[name] + sign * h * torch.eye(own[name].shape[1]).double()[i]} for sign in (1, -1)]
        Kr = [torch.linalg.eigvalsh(system.dynamics(x).data["Kr"][..., 0, 0].permute(2, 0, 1)) for x in moved]
        K, dK = data["Kr"].value[..., 0, 0].permute(2, 0, 1), data["Kr"].tangent[..., k, 0].permute(2, 0, 1)
        vectors = torch.linalg.eigh(K).eigenvectors
        slopes = torch.einsum("bim,bij,bjm->bm", vectors, dK, vectors)
        assert_close(slopes, (Kr[0] - Kr[1]) / (2 * h), rtol=0, atol=1e-6 * float(K.abs().max()))


@pytest.mark.thorough
def test_quantities_without_tangents_stay_plain():
    """The mass does not depend on the angles: carrying zeros would cost as much as numbers."""
    system = pendulum()
    data = system.dynamics({"rod.laminate.angles": mbd.deg([[10.0, 20.0]])}, tangents=["rod.laminate.angles"]).data
    assert isinstance(data["Kr"], Pair)
    assert not any(isinstance(data[name], Pair) for name in ("mass", "S0", "P0", "mu", "x"))


class TestDoor:
    """Every argument of System is refused with its name, its value and what is allowed."""

    def test_bodies(self):
        with refused("bodies", []):
            mbd.System([])
        with refused("bodies", "a"):
            mbd.System([box("a"), box("a")])

    @pytest.mark.parametrize(
        "name", ["dynamics", "forward", "topology", "body", "_saddle", "train", "stabilization", "data"]
    )
    def test_a_name_that_would_hide_an_attribute(self, name):
        with refused("bodies"):
            mbd.System([box(name)])

    def test_joints_to_bodies_that_are_not_in_the_system(self):
        a, b = box("a"), box("b")
        with refused("joints.spherical_a_b"):
            mbd.System([a], [mbd.Spherical(a.at(), b.at())])

    def test_a_body_called_ground_is_not_the_ground(self):
        with refused("name", "ground"):
            box("ground")

    @pytest.mark.parametrize("gravity", [9.81, (0.0, -9.81), (0.0, 0.0, math.inf)])
    def test_gravity(self, gravity):
        with refused("gravity"):
            mbd.System([box("a")], gravity=gravity)

    @pytest.mark.parametrize("time", [0.0, -1.0, math.nan])
    def test_stabilization(self, time):
        with refused("stabilization"):
            mbd.System([box("a")], stabilization=time)

    def test_forces_are_refused_until_there_are_some(self):
        with refused("forces"):
            mbd.System([box("a")], forces=[object()])

    def test_body_names(self):
        with refused("body", "rdo", meant="rod"):
            pendulum().body("rdo")

    def test_parameters(self):
        system = pendulum()
        with refused("parameter", "rod.laminate.angle", meant="rod.laminate.angles"):
            system.dynamics({"rod.laminate.angle": mbd.deg([[1.0, 2.0]])})
        with refused("rod.laminate.angles"):
            system.dynamics({"rod.laminate.angles": mbd.deg([1.0, 2.0])})
        with refused("tangents", "rod.laminate.angles"):
            system.dynamics({}, tangents=["rod.laminate.angles"])

    def test_lanes_that_do_not_agree(self):
        result = [plate("one"), plate("two", made_of=laminate((10.0, 80.0)))]
        with refused("lanes"):
            mbd.System(result).dynamics(
                {"one.laminate.angles": torch.zeros(2, 3).double(), "two.laminate.angles": torch.zeros(3, 2).double()}
            )


class TestJointDoor:
    """Joints refuse what cannot be joined."""

    def test_a_body_instead_of_a_frame(self):
        with refused("a"):
            mbd.Spherical(box("a"), box("b").at())

    def test_a_frame_with_its_own_body(self):
        a = box("a")
        with refused("b"):
            mbd.Spherical(a.at(), a.at(0.1, 0.0, 0.0))

    def test_two_frames_on_the_ground(self):
        with refused("b"):
            mbd.Spherical(mbd.Ground().at(), mbd.Ground().at(0.1, 0.0, 0.0))

    @pytest.mark.parametrize("kind", [mbd.Revolute, mbd.Prismatic, mbd.Cylindrical])
    @pytest.mark.parametrize("axis", ["w", "X", "", "xy", 2, None])
    def test_axis(self, kind, axis):
        with refused("axis"):
            kind(box("a").at(), box("b").at(), axis=axis)

    @pytest.mark.parametrize("axes", ["x", "xx", "xyz", "xw", ("x", "y")])
    def test_axes_of_a_universal_joint(self, axes):
        with pytest.raises(InputError, match=r"(universal_a_b.axes|axis) = .*: must"):
            mbd.Universal(box("a").at(), box("b").at(), axes=axes)

    @pytest.mark.parametrize("length", [0.0, -1.0, math.nan, math.inf])
    def test_length(self, length):
        with refused("distancejoint_a_b.length"):
            mbd.DistanceJoint(box("a").at(), box("b").at(), length=length)

    @pytest.mark.parametrize(
        "given", [{}, {"speed": 1.0, "angle": torch.sin}, {"speed": math.nan}, {"speed": math.inf}]
    )
    def test_drive(self, given):
        with pytest.raises(InputError, match=r"drive_a_b.* (has|= nan|= inf).*: must"):
            mbd.Drive(box("a"), box("b"), **given)

    @pytest.mark.parametrize("law", [0.3, lambda t: 0.3, lambda t: t.expand(1), lambda t: t / 0])
    def test_law_of_a_drive(self, law):
        with refused("drive_a_b.angle"):
            mbd.Drive(box("a"), box("b"), angle=law)

    def test_drive_between_numbers(self):
        with refused("frame", 3):
            mbd.Drive(3, box("b"), speed=1.0)


def test_a_drive_takes_bodies_of_every_kind():
    """Without a frame it acts on the axes of the body; on a flexible body, those of its reference node."""
    body = plate("rod", reference="left")
    drive = mbd.Drive(mbd.Ground(), body, axis="x", speed=2.0)
    assert drive.b.interpolation.nodes == tuple(body.reference)
    system = mbd.System([body], [drive])
    z = system().initial_state()[0].detach()
    assert_close(z[system.topology.n_q :][3:6], tensor(2.0, 0.0, 0.0), rtol=1e-12, atol=1e-12)


def test_what_a_system_is_not_made_of():
    """No traceback from the depth of torch: the argument, its value, what is allowed."""
    hub = box("hub")
    joint, spring = mbd.Revolute(mbd.Ground().at(), hub.at()), mbd.SpringDamper(mbd.Ground().at(), hub.at(), 1.0)
    for make, path in (
        (lambda: mbd.System(hub), "bodies"),  # pyright: ignore
        (lambda: mbd.System([mbd.Ground()]), "bodies"),
        (lambda: mbd.System([hub], joint), "joints"),  # pyright: ignore
        (lambda: mbd.System([hub], [spring]), "joints"),  # pyright: ignore
        (lambda: mbd.System([hub], [joint], [joint]), "forces"),  # pyright: ignore
        (lambda: mbd.System([hub], free="hub"), "free"),
        (lambda: mbd.simulate(hub, 1.0), "system"),  # pyright: ignore
        (lambda: box("lost", position=torch.zeros(3, requires_grad=True)), "lost.position"),
        (
            lambda: mbd.FlexibleBody.plate("p", mbd.mesh.rectangle(1.0, 1.0, (1, 1)), None),
            "laminate",
        ),
        (lambda: mbd.Revolute(mbd.Ground().at(), hub.at(), name=3), "name"),  # pyright: ignore
        (lambda: mbd.Drive(mbd.Ground(), hub, angle=lambda: 0.0), "drive_ground_hub.angle"),  # pyright: ignore
    ):
        with refused(path):
            make()


def test_designs_that_are_none():
    rod = plate("rod", 1)
    system, name = mbd.System([rod]), "rod.laminate.angles"
    good = rod.laminate.angles.detach()[None]
    for designs, path in (
        ([good], "designs"),
        ({name: good.tolist()}, f"designs.{name}"),
        ({name: good.float()}, f"designs.{name}"),
        ({name: good[:0]}, f"designs.{name}"),
        ({name: torch.cat([good, good * torch.nan])}, name),
    ):
        with refused(path):
            mbd.simulate(system, 0.01, steps=1, designs=designs)  # pyright: ignore


class _Nameless:
    """A kind of equation or action that is none."""


def test_a_kind_without_the_base_class_is_refused_by_its_name():
    """It would be left out: a joint without its equation, a force that does not act."""
    body = box("arm")

    class Odd(Joint):
        def equations(self, attachments):
            yield Equation(_Nameless, (attachments.point(self.a), attachments.point(self.b)))

    class Pull(ForceElement):
        def actions(self, attachments):
            yield Applied(_Nameless, (attachments.point(self.frames[0]),), None)

    ground = mbd.Ground().at()
    with refused("odd"):
        mbd.System([body], [Odd(ground, body.at(), name="odd")])
    with refused("pull"):
        mbd.System([body], forces=[Pull((body.at(),), name="pull")], free=["arm"])
