"""The result of a simulation: coordinates, rates, accelerations, multipliers, and their sensitivities.

Axes are lanes (designs), times, components, the design axis last:

    t [times]   q [lanes, times, n_q]   v, a [lanes, times, n_v]   lam [lanes, times, rows]
    dq_db [lanes, times, n_q, n_b]   dv_db, da_db [lanes, times, n_v, n_b]   dlam_db [lanes, times, rows, n_b]

Sensitivities of modal rows go with the basis, which moves with the design (fem/reduction/transport.py): differences of w of two
designs are something else, for each has modes of its own. Responses do not depend on the choice.

Rows of the whole system, multipliers of condensed joints and mode shapes are computed on demand (time_rows.py,
mode_shapes.py). A lane that failed says why in `status`; its numbers are nan from the failure on and must not be used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from torchmbd.errors import InputError, one_of, true_or_false
from torchmbd.results.beam_motion import BeamMotion
from torchmbd.results.body_motion import BodyMotion
from torchmbd.results.energies import Energies, energies
from torchmbd.results.motion_data import MotionData
from torchmbd.results.reaction import JointReaction, reaction
from torchmbd.results.response_error import ResponseError
from torchmbd.results.singular_positions import SingularPosition, singular_positions
from torchmbd.results.table import table

if TYPE_CHECKING:
    from pandas import DataFrame


class Repeated(Protocol):
    """How a motion is made again by finer models, and compared with them: `Repetition` (diagnosis/repetition.py)."""

    @property
    def steps(self) -> int: ...

    @property
    def multiple(self) -> int: ...

    @property
    def order(self) -> int | None: ...

    @property
    def has_equal_steps(self) -> bool: ...

    def finer(self, factor: int) -> Trajectory: ...

    def coarser(self) -> Trajectory | None: ...

    def by_longer_steps(self, motion: Trajectory) -> Trajectory | None: ...

    def richer(self, motion: Trajectory) -> Trajectory | None: ...

    def with_finer_meshes(self, motion: Trajectory) -> Trajectory | None: ...

    def error_of(self, motion: Trajectory, response: Any, modes: bool, mesh: bool) -> ResponseError: ...


@dataclass(eq=False, repr=False)
class Trajectory(MotionData):
    """A motion of one design or of a batch, made by `simulate`; its numbers are those of `MotionData`.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> motion.status, motion.t.shape, motion.body("arm").nodes.shape  # lanes, times, nodes, x y z
    (['ok'], torch.Size([41]), torch.Size([1, 41, 15, 3]))
    >>> motion.reaction("hinge").force.shape  # [N]
    torch.Size([1, 41, 3])
    >>> motion.to_dataframe("tool", "hinge").columns[[0, -1]].tolist()
    ['tool x [m]', 'hinge torque z [N m]']
    """

    repetition: Repeated | None = field(default=None, init=False, repr=False)  # None: a part of a motion
    _energies: dict[bool, Energies] = field(default_factory=dict, init=False, repr=False)

    def body(self, name: str) -> Any:
        """The motion of one body (BodyMotion), or of one flexible beam (BeamMotion)."""
        beams = [beam.name for beam in self.system.beams]
        if name in beams:
            return BeamMotion(self, name)
        return BodyMotion(self, one_of("body", name, [*self.dynamics.topology.names, *beams]))

    def reaction(self, joint: str) -> JointReaction:
        """Force and torque of a joint on its second body, in the frame of its first."""
        return reaction(self, joint)

    def to_dataframe(self, *names: str, histories: Mapping[str, Callable[[Any], Tensor]] | None = None) -> DataFrame:
        """The motion as a table: a row for each lane and time, indexed by lane and "t [s]". Headings have units.

        names       of bodies (place, velocity, orientation, angular velocity, modal coordinates), of flexible beams (places of
                    nodes, strains and section forces of elements), and of joints (reaction on the second body, in ground axes)
        histories   heading -> history, such as {"energy [J]": mbd.StrainEnergy("arm")}; a function that returns [lanes, times]
        Values only. Raises InputError that names what does not exist.
        """
        return table(self, names, histories)

    @property
    def energies(self) -> Energies:
        """Kinetic, strain and potential energy, what was dissipated, and the work of forces and drives, over time."""
        mode = torch.is_grad_enabled()  # energies of one mode have no gradient, those of the other keep a graph
        if mode not in self._energies:
            self._energies[mode] = energies(self)
        return self._energies[mode]

    def require_repetition(self) -> Repeated:
        """The arguments that simulate this motion again; InputError for a part of a motion."""
        if self.repetition is None:
            raise InputError("motion", allowed="the motion that simulate returns", state="is a part of another")
        return self.repetition

    def error_of(self, response: Callable[[Any], Tensor], *, modes: bool = True, mesh: bool = True) -> ResponseError:
        """Estimated errors of a measure. The motion is simulated again with half the step, and if necessary with twice or a
        quarter of the step; then with more modes, and with finer meshes.

        response      a measure, such as mbd.Max(...), or a function of a motion that returns [lanes] or [lanes, rows]
        modes, mesh   whether the errors by the modes and by the meshes of flexible bodies are estimated
        Raises InputError for a history, and for a method of fixed steps of torchdiffeq.
        """
        return self.require_repetition().error_of(
            self, response, true_or_false("modes", modes), true_or_false("mesh", mesh)
        )

    def singular_positions(self) -> list[SingularPosition]:
        """Positions near to the motion at which its constraints lose rank, with their times."""
        return singular_positions(self)
