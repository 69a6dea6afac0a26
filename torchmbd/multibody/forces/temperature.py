"""Changes of temperature and moisture of a flexible body of plates or beams, as a load.

    Q = T(t) Psi' F        F: loads on the nodes that cause the free expansion by a unit change (bodies/expansion.py)

Q acts on the modal coordinates w alone. It is that of the action Along: the vector b = A (S w), S = e_x (Psi' F)' of the body,
has the coordinate b . A e_x = F' Psi w along the body's x-axis, whatever the rotation A. So a change of temperature is data of
compiled code and has derivatives with respect to the design as every force has.
The stress of a ply is that of the strain less its free strain (results/ply_history.py).
In a body with stiffening the stress of the change, that of K^-1 F less that of the free strain, acts on the displacements of
second order: a body that is held at both ends vibrates more slowly when it is warm.
Assumed: moduli, coefficients and mass do not depend on temperature or moisture; the change is constant in each zone, and linear
through the thickness.
Source: as in fem/materials/expansion.py; T. J. R. Hughes, The Finite Element Method (1987), initial strains.
Checked in tests/multibody/forces/test_temperature.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.exact_beam import ExactBeam
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.action import Along
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import OfTime, Scaled, check_law
from torchmbd.multibody.forces.parametric_law import ParametricLaw
from torchmbd.multibody.joints.joint import Attached, AttachmentTable

Change = float | Tensor | Callable[[Tensor], Tensor] | Scaled


@dataclass(frozen=True, eq=False)
class ExpansionVector(Attached):
    """A vector of a body whose first component is the work of the loads of a unit change on the modes; zero at rest."""

    zone: str | None = None
    change: str = "temperature"

    @property
    def key(self) -> tuple:
        """Key that is equal for equal vectors."""
        return *super().key, self.zone, self.change

    def modal_rows(self, psi: Tensor) -> Tensor:
        """Derivative with respect to the modal coordinates [..., 3, modes], out of mode shapes psi [..., nodes, 6, modes]."""
        F = self.body.expansion.forces(self.zone, self.change)
        work = (psi * F[..., None]).sum((-3, -2))
        none = torch.zeros_like(work)
        return torch.stack([work, none, none], -2)

    def quadratic_rows(self, psi: Tensor, psi2: Tensor, nodes: Sequence[int]) -> Tensor:
        """Second derivative in the modal coordinates [..., 3, modes, modes]; psi2 and nodes have no influence."""
        work = self.body.expansion.second_order(self.zone, self.change, psi)
        none = torch.zeros_like(work)
        return torch.stack([work, none, none], -3)

    def load_size(self) -> float:
        """Sum of all nodal forces of a unit change, and of all moments by the length of the body, of the first lane [N]."""
        F = self.body.expansion.forces(self.zone, self.change).detach()
        F = F.reshape(-1, *F.shape[-2:])[0]
        length = float((self.body.mesh.nodes - self.body.origin).norm(dim=-1).max())
        return float(F[:, :3].norm(dim=-1).sum() + F[:, 3:].norm(dim=-1).sum() / length)


class Temperature(ForceElement):
    """`Temperature(body, 80.0)`: a change of the temperature [K] of a flexible body from its stress-free temperature.

    body         a flexible body of plates, shells or beams whose plies have coefficients of expansion
    temperature  at z = 0, the surface of the nodes [K]: a number, or a torch function of time, [] [s] -> [] [K]; a design
                 variable "NAME.temperature" as mbd.variable(80.0), or as mbd.forces.Scaled(mbd.variable(1.0), function)
    gradient     per meter along the normal of plates, or along the z-axis of sections of beams [K/m]
    gradient_y   per meter along the y-axis of sections of beams [K/m]
    moisture     change of the moisture, a share of the mass [-]
    zone         name of the part of the body that changes; None: the whole body
    name         of the element, and of its design variables

    A body should have expansion=True, so that it retains the static shapes of these changes (`FlexibleBody.plate`).

    >>> ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
    >>> laminate = mbd.Laminate(ply, mbd.deg([0, 90]), thickness=0.125e-3)
    >>> mesh = mbd.mesh.rectangle(0.2, 0.02, (8, 2))
    >>> strip = mbd.FlexibleBody.plate("strip", mesh, laminate, 2, reference="left", expansion=True)
    >>> hold = mbd.Fixed(mbd.Ground().at(-0.1, 0, 0), strip.at("left"))
    >>> cooled = mbd.equilibrium(mbd.System([strip], [hold], [mbd.Temperature(strip, -1.0)]))
    >>> bool(cooled.body("strip").at("right").position[..., 2] > 0)  # the strip curls
    True
    """

    def __init__(
        self,
        body: Any,
        temperature: Change = 0.0,
        gradient: Change = 0.0,
        gradient_y: Change = 0.0,
        moisture: Change = 0.0,
        zone: str | None = None,
        name: str | None = None,
    ):
        if getattr(body, "expansion", None) is None:
            shown = repr(getattr(body, "name", body))
            allowed = "a flexible body of plates or beams, not an exact beam"
            hint = "ExactBeam.equilibrium(temperature=...)" if isinstance(body, ExactBeam) else ""
            raise InputError("body", body, allowed, hint=hint, noun="body of Temperature", shown=shown)
        known = body.expansion.changes(zone)
        super().__init__(
            (body.at(body.reference[0]),), name or "_".join(["temperature", body.name, *([zone] if zone else [])])
        )
        self.body, self.zone = body, zone
        amounts = {"temperature": temperature, "gradient": gradient, "gradient_y": gradient_y, "moisture": moisture}
        self.changes = {key: x for key, x in amounts.items() if isinstance(x, Tensor) or callable(x) or x != 0.0}
        for change in self.changes:
            if change not in known:
                raise InputError((self.name, change), allowed=known, state="is given")
            with torch.no_grad():
                body.expansion.forces(zone, change)  # the plies have the coefficients
        body.expansion.warn_of_other_parts(zone)
        self.laws = {change: check_law(self.name, self._law(change, x)) for change, x in self.changes.items()}

    def _law(self, change: str, x: Change) -> Any:
        if isinstance(x, Scaled):
            return self.law_variables.law(Scaled(x.factor, OfTime(x.law)), factor=change)
        return self.law_variables.law_of_time(x, change)

    def histories(self, times: Tensor) -> dict[str, Tensor]:
        """Each change at times [t] in the present design [*lanes, t]."""
        zero, histories = torch.zeros(1, 1, len(times), dtype=torch.float64), {}
        variables = [*self.law_variables.numbers.values()]  # in the order of the rows: changes may share one
        for change, law in self.laws.items():
            if isinstance(law, ParametricLaw):
                ((_, row),) = law.rows
                histories[change] = variables[row][..., None] * law.law.law(zero, zero, times)[0, 0]
            else:
                histories[change] = law(zero, zero, times)[0, 0]
        return histories

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        none, x = torch.zeros(3, dtype=torch.float64), torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        for change, law in self.laws.items():
            origin = attachments.add(Attached(Ground(), none, None, False))
            axis = attachments.add(Attached(self.body, x, None, False))
            vector = attachments.add(ExpansionVector(self.body, none, None, False, zone=self.zone, change=change))
            yield Applied(Along, (origin, vector, axis), law)
