"""Frequency responses about a state, differentiable: complex amplitudes of outputs by unit amplitudes of inputs.

    P(s) r = (f, 0),  G = c r,  s = i w         r = (x, multipliers), P of spectrum.py, f: forces of a unit input
    l^H P(s) = (c, 0)                           c: output by increments x and their rates s x, or s or s^2 times it: its rates

    dG = -l^H dP r + dc x + l^H df              dP, dc and df by the state, the data and the multipliers that balance them

Numbers of G are derived as eigenvalues are (eigenvalues.py), of which this is one family more: each is a term.
Inputs and outputs are those of `linearize`, the actuators and signals of controllers, in a system with ports.
Checked in tests/extensions/vibrations/test_frequency_response.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.vibrations.eigenvalues import POLES, AboutState, Term
from torchmbd.extensions.vibrations.inner_products import Vectors, inner, inner_products, real_and_imaginary
from torchmbd.extensions.vibrations.linear_system import link_of_ports
from torchmbd.extensions.vibrations.port_functions import PortFunctions, Ports
from torchmbd.extensions.vibrations.spectrum import Spectrum
from torchmbd.integrate.motion import Motion
from torchmbd.integrate.pullback import leaf
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation
from torchmbd.multibody.saddle.rank import RELATIVE
from torchmbd.multibody.system import Dynamics
from torchmbd.simulation.equilibrium import Equilibrium

QUANTITIES = ("displacement", "velocity", "acceleration")  # an output and its rates, in the order of `Responses.order`


def frequency_response(
    rest: Equilibrium, ports: Ports, frequencies: Tensor, rows: Sequence[int] | None = None, order: int = 0
) -> Tensor:
    """G [lanes, frequencies, outputs, inputs], complex, at frequencies [Hz]; differentiable as the state is.

    rest   a state of a system with these ports
    rows   numbers of the outputs among those of the ports; None: all.  order: 1, 2 for their first, second rate
    """
    dynamics, h = rest.dynamics, rest.signals.history  # pyright: ignore[reportAttributeAccessIssue]
    read = link_of_ports(dynamics).read
    read = read if rows is None else read[list(rows)]
    problem = Responses(
        **arguments_of(dynamics, rest.t[-1], rest.rotation),
        functions=PortFunctions(dynamics.topology, rest.t[-1], ports, read),
        roots=2j * math.pi * frequencies,
        order=order,
    )
    G = problem.of(h.q[-1], dynamics)
    return G.T.unflatten(1, (len(frequencies), len(read), ports.u.shape[-1]))


def arguments_of(dynamics: Dynamics, t: Tensor, rotation: SteadyRotation | None) -> dict[str, Any]:
    """What `Responses` about a state share with eigenvalues."""
    model = replace(dynamics, data={})
    shared = {"model": model, "names": tuple(dynamics.data), "t": t, "rotation": rotation}
    return {"kind": POLES, "modes": None, "symmetric": True, **shared}


@dataclass(frozen=True, eq=False)
class _Vectors(Spectrum):
    """Right and left vectors of all numbers of G, in the order frequencies, outputs, inputs, in the place of eigenvectors."""

    at: Tensor

    @property
    def roots(self) -> Tensor:
        return self.at


@dataclass(eq=False, kw_only=True)
class Responses(AboutState):
    """Numbers of G in the place of eigenvalues.

    functions   inputs and outputs;  roots: s [frequencies];  order: 1, 2 for the first, second rate of the outputs
    """

    functions: PortFunctions
    roots: Tensor
    order: int = 0

    def of(self, q: Tensor, dynamics: Dynamics) -> Tensor:
        """G [frequencies x outputs x inputs, lanes] about q [n_q, 1, lanes]."""
        real, imag = Motion.apply(self, q, *dynamics.data.values())  # pyright: ignore[reportGeneralTypeIssues]
        return torch.complex(real[:, 0], imag[:, 0])

    def _spectra(self) -> list[Any]:
        result = []
        for lane in range(self.inputs[0].shape[-1]):
            q, data = self._split([x[..., lane : lane + 1] for x in self.inputs])
            [rest] = Linearization.each(replace(self.model, data=data), q, self.t, None, self._observer(data))
            self.balance.append(rest)
            result.append(self._vectors_of(rest, q, data))
        return result

    def _size(self, lane: int) -> int:
        return len(self.spectra[lane].values)

    def _vectors_of(self, rest: Linearization, q: Tensor, data: dict[str, Tensor]) -> _Vectors:
        """Solve for all inputs and outputs of one design."""
        at, ports, active = (q, data, self._observer(data)), self.functions, rest.active
        ports.require_steady(*at)
        f = torch.cat([ports.forces(*at, k)[active][..., 0] for k in range(len(ports.ports.u))], 1)
        c, rates = (x[:, active, 0] for x in ports.output_rows(*at))
        roots = self._roots(rest, f, c, rates)
        s = roots[:, None, None]
        N, M, C, K = (x.to(s.dtype) for x in (rest.N, rest.M, rest.C, rest.K))
        P = s * s * M[active][:, active] + s * C[active][:, active] + K[active][:, active]
        Z = s * s * rest.inertia + s * rest.reduced(rest.C) + rest.stiffness
        y = s**self.order * (c + s * rates)  # [frequencies, outputs, active]
        try:
            right = N @ torch.linalg.solve(Z, (N.T @ f.to(s.dtype))[None])
            left = N @ torch.linalg.solve(Z.mH, N.T @ y.mH)
        except RuntimeError as error:  # of torch.linalg
            raise InputError(
                "frequencies", allowed="other frequencies [Hz]", state=f"has a pole without damping ({error})"
            ) from None
        back = torch.linalg.pinv(rest.Phi_q[:, active].T, rtol=RELATIVE).to(s.dtype)
        force, slip = back @ (f - P @ right), back @ (y.mH - P.mH @ left)
        outputs, inputs = y.shape[1], f.shape[1]
        count, none = len(s) * outputs * inputs, N.new_zeros(len(rest.forces), 1)

        def each(x: Tensor, axis: int) -> Tensor:
            """Columns [n, numbers of G] of x [frequencies, n, inputs] or, along axis 2, [frequencies, n, outputs]."""
            return x.mT.unsqueeze(axis).expand(-1, outputs, inputs, -1).flatten(0, 2).T

        return _Vectors(
            values=(y @ right).flatten(),
            right=none.expand(-1, count).index_copy(0, active, each(right, 1)),
            left=none.expand(-1, count).index_copy(0, active, each(left, 2)),
            force=each(force, 1),
            slip=each(slip, 2),
            cluster=torch.arange(count),
            fault=("",) * count,
            at=roots.repeat_interleave(outputs * inputs),
        )

    def _roots(self, rest: Linearization, f: Tensor, c: Tensor, rates: Tensor) -> Tensor:
        """s [frequencies] of a design; forces f [active, inputs], outputs by increments and rates [outputs, active]."""
        return self.roots

    def _slopes(self, terms: Sequence[Term]) -> tuple[list[Tensor], list[Tensor]]:
        leaves = [leaf(x[..., [term.lane for term in terms]]) for x in self.inputs]
        with torch.enable_grad():
            q, data = self._split(leaves)
            at = q, data, self._observer(data)
            s, right, force = self._vectors(terms, "right", "roots", "right", "force")
            left, slip = self._vectors(terms, "left", "left", "slip")
            vectors = Vectors(left, slip, right, force)
            balance = [self.balance[term.lane] for term in terms]
            products = inner_products(self.model.topology, data, q, self.t, at[2], balance, s, vectors)
            outputs, inputs = (torch.tensor(x) for x in zip(*map(self._place, terms), strict=True))
            x, xd = (real_and_imaginary(s ** (self.order + k) * right) for k in range(2))
            y = self.functions.outputs(*at, x, xd)
            output = y.gather(0, outputs.expand(1, 2, -1))[0]  # [2, terms]
            forces = [self.functions.forces(*at, k) * (inputs == k) for k in set(inputs.tolist())]
            f = torch.stack(forces).sum(0)
            work = inner(vectors.left, torch.cat([f, torch.zeros_like(f)], 1))
            return leaves, [a + b - c for a, b, c in zip(output[:, None], work, products, strict=True)]

    def _place(self, term: Term) -> tuple[int, int]:
        """Output and input of a number of G."""
        inputs = len(self.functions.ports.u)
        return term.right // inputs % len(self.functions.read), term.right % inputs
