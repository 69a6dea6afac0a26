"""Systems whose constructors were given variables for numbers, and what is asked of their gradients."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, finished, tensor, turned

STEPS = {"steps": 6, "iterations": (8, 4)}
GROUND = mbd.Ground()


def hung(rod: mbd.FlexibleBody, end: str = "left") -> mbd.System:
    """A body that hangs from a hinge out of every plane and falls."""
    hinge = mbd.Revolute(GROUND.at(0.1, 0.0, 0.2, axes=turned(0.2, 0.5, -0.4)), rod.at(end), axis="x", name="hinge")
    return mbd.System([rod], [hinge], gravity=GRAVITY)


def number(system: mbd.System, designs: dict[str, Tensor], duration: float = 0.02, **options) -> Tensor:
    """One that everything goes into [lanes]: motion, reactions, energies, mass and frequencies."""
    motion = finished(mbd.simulate(system, duration, designs=designs, **(STEPS | options)))
    n = len(system.bodies)  # modal coordinates depend on which basis of their subspace was taken
    parts = [motion.q[..., : 7 * n], 0.1 * motion.v[..., : 6 * n], 1e-2 * motion.a[..., : 6 * n], motion.lam]
    total = torch.zeros(())
    for body in system.bodies:
        total = total + mbd.Mass(body.name)(motion)
        if hasattr(body, "mesh"):
            parts.append(motion.body(body.name).nodes)
            total = total + 1e-2 * mbd.Frequency(body.name)(motion)
            total = total + mbd.Integral(mbd.StrainEnergy(body.name))(motion)
    total = total + sum((y * (1.0 + y)).flatten(1).sum(1) for y in parts)
    energies = motion.energies
    return total + energies.kinetic.sum(1) + energies.stored.sum(1)


SHIFTS = (1.0, -1.0, 2.0, -2.0, 4.0, -4.0)


def differences(f, system: mbd.System, names: list[str], steps: dict[str, float] | None = None) -> dict[str, Tensor]:
    """Richardson differences of f(designs) [lanes] by every entry of some parameters, all in one batch.

    steps  of parameters, as a share of their largest entry; others: 1e-3
    """
    own = {name: system.get_parameter(name).detach() for name in names}
    entries = [
        (name, k, (steps or {}).get(name, 1e-3) * float(x.abs().max()))
        for name, x in own.items()
        for k in range(x.numel())
    ]
    lanes = len(SHIFTS) * len(entries)
    designs = {name: x.reshape(1, -1).repeat(lanes, 1) for name, x in own.items()}
    for i, (name, k, h) in enumerate(entries):
        designs[name].unflatten(0, (-1, len(SHIFTS)))[i, :, k] += h * tensor(*SHIFTS)
    with torch.no_grad():
        values = f({name: x.reshape(lanes, *own[name].shape) for name, x in designs.items()})
    slopes = []
    for y, (_, _, h) in zip(values.unflatten(0, (-1, len(SHIFTS))), entries, strict=True):
        one, two, four = ((y[k] - y[k + 1]) / (2.0 * s * h) for k, s in ((0, 1.0), (2, 2.0), (4, 4.0)))
        first, second = (4.0 * one - two) / 3.0, (4.0 * two - four) / 3.0
        slopes.append((16.0 * first - second) / 15.0)
    parts = torch.stack(slopes).split([x.numel() for x in own.values()])
    return {name: part.reshape(x.shape) for part, (name, x) in zip(parts, own.items(), strict=True)}


def check(system: mbd.System, names: list[str], f=number, steps: dict[str, float] | None = None, **options) -> None:
    """Forward = reverse, both = differences; as leaves of designs and as the parameters themselves; native = eager."""
    start = {name: system.get_parameter(name).detach().clone() for name in names}
    result: dict[str, dict[str, Tensor]] = {}
    for way in ("reverse", "forward"):
        x = {name: y.clone().requires_grad_() for name, y in start.items()}
        f(system, x, gradients=way, **options).sum().backward()
        result[way] = {name: y.grad for name, y in x.items()}
    expected = differences(lambda b: f(system, b, **options), system, names, steps)
    for name in names:
        one, other = result["reverse"][name], result["forward"][name]
        size = float(one.abs().max())
        assert size > 0.0, name
        assert_close(other, one, rtol=0, atol=1e-8 * size, msg=lambda m, n=name: f"{n}: {m}")
        assert_close(one, expected[name], rtol=0, atol=1e-6 * size, msg=lambda m, n=name: f"{n}: {m}")
    system.zero_grad()
    f(system, {}, **options).sum().backward()
    for name in names:
        own = system.get_parameter(name).grad
        assert_close(own, result["reverse"][name], rtol=0, atol=1e-8 * float(own.abs().max()))


def check_native(system: mbd.System, names: list[str], f=number, **options) -> None:
    """Two designs by both backends, each as if it were alone."""
    both = {name: torch.stack([y, 1.01 * y]) for name, y in system.named_parameters() if name in names}
    result = []
    for backend in ("eager", "native"):
        x = {name: y.detach().clone().requires_grad_() for name, y in both.items()}
        f(system, x, backend=backend, **options).sum().backward()
        result.append({name: y.grad for name, y in x.items()})
    alone = {name: y.detach()[1].clone().requires_grad_() for name, y in both.items()}
    f(system, alone, **options).sum().backward()
    for name in names:
        size = float(result[0][name].abs().max())
        assert_close(result[1][name], result[0][name], rtol=0, atol=1e-7 * size)
        assert_close(result[0][name][1], alone[name].grad, rtol=0, atol=1e-7 * size)


def beam(section, name: str = "rod", line: mbd.BeamLine | None = None, modes: int = 3, **given) -> mbd.FlexibleBody:
    """A beam of a few elements that leans."""
    line = line or mbd.BeamLine.straight(0.3, elements=4)
    return mbd.FlexibleBody.beam(name, line, section, modes=modes, axes=turned(0.3, -0.2, 0.5), **given)


def ply(scale: float = 1.0, **given) -> mbd.Ply:
    """A soft ply of a solid; what is given replaces numbers of it."""
    numbers = SOFT | {"G23": 3.6e6} | given
    return mbd.Ply(**numbers)


__all__ = ["beam", "check", "check_native", "differences", "hung", "number", "ply", "tensor"]
