"""BeamDyn blade files: the table in our axes, and files that are refused by line."""

from __future__ import annotations

import numpy as np
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import coupled
from tests.refused import ANY, refused


def test_a_blade_file_of_beamdyn(tmp_path):
    """Its axes are x, y, z with z along the blade; the same blade by our own axes bends alike."""
    ours, mass = coupled().numpy(), np.diag([2.0, 2.0, 2.0, 3e-3, 1e-3, 2e-3])
    to_theirs = [1, 2, 0, 4, 5, 3]  # theirs x, y, z are ours y, z, x
    blocks = []
    for s, scale in ((0.0, 1.0), (1.0, 0.6)):
        rows = [
            "\n".join(" ".join(f"{v:.14E}" for v in row) for row in x[np.ix_(to_theirs, to_theirs)])
            for x in (scale * ours, mass)
        ]
        blocks.append(f"  {s:.6f}\n{rows[0]}\n\n{rows[1]}\n")
    head = "------- BEAMDYN V1.00.* INDIVIDUAL BLADE INPUT FILE ---\n Test\n---- Blade Parameters ----\n"
    damping = "2   station_total  - Number\n1   damp_type\n---- Damping ---\nmu1 mu2\n1.0E-03 1.0E-03\n"
    file = tmp_path / "blade.inp"
    file.write_text(head + damping + "---- Distributed Properties ----\n" + "\n".join(blocks))
    read = mbd.io.read_beamdyn(file)
    own = mbd.SectionTable([0.0, 1.0], [(ours, mass), (0.6 * ours, mass)])
    line = mbd.BeamLine.straight(1.0, 4)
    result = [mbd.ExactBeam("blade", line, t).equilibrium({"end": (0.1, 0.5, 0.3)}).nodes for t in (read, own)]
    torch.testing.assert_close(result[0], result[1], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(read.mass(torch.tensor([0.5])), own.mass(torch.tensor([0.5])))


def test_files_that_are_refused(tmp_path):
    rows = "\n".join(" ".join("2" if i == j else "0" for j in range(6)) + "  a comment" for i in range(6))
    good = f"2 station_total\n--- Distributed Properties ---\n0.0 ! root\n{rows}\n\n{rows}\n1.0\n{rows}\n{rows}\nEND\n"
    (tmp_path / "good.inp").write_text(good)
    assert torch.equal(
        mbd.io.read_beamdyn(tmp_path / "good.inp").mass(torch.tensor([0.3]))[0].diagonal(),
        2.0 * torch.ones(6, dtype=torch.float64),
    )
    for old, new, argument, fact in (
        (good, "nothing", "bad.inp", "no stations"),
        ("2 station_total", "two station_total", "bad.inp", "'two'"),
        ("2 station_total", "1000000000000 station_total", "bad.inp", "27 lines for 1000000000000 stations"),
        ("1.0\n", "x\n", "bad.inp, line 17", "'x'"),
    ):
        (tmp_path / "bad.inp").write_text(good.replace(old, new))
        with refused(argument, ANY, fact):
            mbd.io.read_beamdyn(tmp_path / "bad.inp")
    with refused("path"):
        mbd.io.read_beamdyn(tmp_path / "none.inp")
