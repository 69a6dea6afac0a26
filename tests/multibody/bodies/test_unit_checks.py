"""Units that look wrong by a factor of a thousand are doubted by size, density or speed of sound; right ones are not."""

import dataclasses
import warnings

import pytest

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON
from torchmbd.multibody.bodies.unit_checks import warn_units

PLATE = mbd.mesh.rectangle(0.3, 0.1, (4, 2))
STEEL = mbd.Ply.isotropic(210e9, 0.3, 7850.0)


def made(ply, scale=1.0):
    mesh = mbd.Mesh(PLATE.nodes * scale, node_sets=PLATE.node_sets, quads=PLATE.quads)
    body = mbd.FlexibleBody.plate("plate", mesh, mbd.Laminate(ply, mbd.deg([0, 90]), 2e-3 * scale), 2)
    warn_units("plate", mesh, body.plates.values(), body.structure)  # as readers of files do
    return body


@pytest.mark.parametrize("ply", [CARBON, STEEL, mbd.Ply.isotropic(30e6, 0.3, 60.0)], ids=["carbon", "steel", "foam"])
@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_right_units_are_not_doubted(ply, scale):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made(ply, scale)


@pytest.mark.parametrize(
    ("change", "scale", "words"),
    [
        ({}, 1e3, r"Its size is 316 m, its mass \S+ kg, its first frequency \S+ Hz"),
        ({}, 1e-3, r"Its size is 0.000316 m"),
        ({"density": 1.586e-9}, 1.0, r"density 1.59e-09 kg/m3"),
        ({"density": 1.586e6}, 1.0, r"density 1.59e\+06 kg/m3"),
        (
            {name: getattr(CARBON, name) * 1e-6 for name in ("E1", "E2", "G12", "G13", "G23")},
            1.0,
            r"speed of sound 8.98",
        ),
    ],
    ids=["mm as m", "m as mm", "t/mm3", "g as kg", "MPa as Pa"],
)
def test_wrong_units_are_doubted(change, scale, words):
    with pytest.warns(UserWarning, match=rf"units of body 'plate': .*{words}"):
        made(dataclasses.replace(CARBON, **change), scale)
