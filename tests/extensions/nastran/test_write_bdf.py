"""A design in the deck that its body was read from: read again it is the same body, and other cards keep every byte."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.nastran.bdf_models import model
from tests.refused import ANY, refused, warned
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.cards import read_cards

ANGLES = mbd.deg([0.1234567890123, -61.2345678901234, 133.3])
FACTORS = torch.tensor([1.1, 1.0, 1.0 / 3.0], dtype=torch.float64)
#: Text of the model -> text of another whose PCOMP is written otherwise, or stands for other things.
DECKS = {
    "centered": {},
    "Z0": {"PCOMP,7,,": "PCOMP,7,1.5-3,"},
    "Z0 of a centered stack": {"PCOMP,7,,": "PCOMP,7,-2.25-3,"},
    "blank T and MID": {"YES,1,0.002": "YES,,", ",1,0.0015": ",,.0015"},
    "comments": {"TSAI\n": "TSAI  $ a comment\n$ and a line\n\n"},
    "symmetric": {"TSAI": "TSAI,,,SYM"},
    "large fields": {"PCOMP,7,,,,TSAI": "PCOMP*,7,,,\n*,TSAI"},
    "offset of the elements": {"2,0.\n": "2,0.,2.-3\n"},
}


def deck_text(changes: dict[str, str], **options) -> str:
    """The text of the model with changes."""
    text = model((2, 1), **options)
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


def read(path: Path, name: str, modes: int, **options) -> Any:
    """The body of a file, whose laminates are attributes."""
    return mbd.io.read_bdf(path, name, modes, **options)


def moved(body: Any) -> Any:
    """The body with other plies."""
    with torch.no_grad():
        body.laminate.angles.copy_(ANGLES)
        body.laminate.thickness.mul_(FACTORS)
    return body


def same(a: mbd.FlexibleBody, b: mbd.FlexibleBody) -> None:
    """Mass, center and frequencies agree to 1e-9."""
    first, second = a.structure(), b.structure()
    assert_close(first["mass"], second["mass"], rtol=1e-11, atol=0)
    assert_close(first["S0"], second["S0"], rtol=1e-11, atol=1e-14)
    assert_close(*(torch.linalg.eigvalsh(x["Kr"].detach()) for x in (first, second)), rtol=1e-9, atol=0)


@pytest.mark.parametrize("changes", DECKS.values(), ids=DECKS)
def test_a_deck_read_again_is_the_design(changes, tmp_path):
    """Mass and frequencies agree to 1e-9, and every line outside the card of the plies is the line of the deck."""
    deck = tmp_path / "model.bdf"
    deck.write_text(deck_text(changes))
    body = moved(read(deck, "plate", 3))
    path = mbd.io.write_bdf(body, deck)
    assert path == tmp_path / "model_optimized.bdf"
    same(body, read(path, "plate", 3))
    old, new = (file.read_text().splitlines() for file in (deck, path))
    first = next(k for k, line in enumerate(old) if line.startswith("PCOMP"))
    last = next(k for k, line in enumerate(old) if line.startswith("GRID"))
    assert new[:first] == old[:first]
    assert new[-len(old[last:]) :] == old[last:]
    assert all(line.startswith(("PCOMP*", "*", "$")) or not line for line in new[first : -len(old[last:])])


def test_units_of_the_deck_are_those_that_it_was_read_in(tmp_path):
    """A deck in millimeters gets millimeters."""
    deck = tmp_path / "model.bdf"
    deck.write_text(deck_text({}, millimeters=True))
    body = moved(read(deck, "plate", 3, units="mm"))
    path = mbd.io.write_bdf(body, deck, tmp_path / "other.bdf")
    same(body, read(path, "plate", 3, units="mm"))
    assert "1.1" in path.read_text()


def test_a_design_that_did_not_change_leaves_every_byte(tmp_path):
    """Line ends of Windows, bytes that are no UTF-8, and no end of the last line."""
    deck = tmp_path / "model.bdf"
    deck.write_bytes(deck_text({}).replace("\n", "\r\n").encode().rstrip() + b"\r\n$ M\xfcnchen")
    body = read(deck, "plate", 3)
    path = mbd.io.write_bdf(body, deck)
    assert path.read_bytes() == deck.read_bytes()
    mbd.io.write_bdf(moved(body), deck)
    lines = path.read_bytes().splitlines(keepends=True)
    assert lines[-1] == b"$ M\xfcnchen"
    assert all(line.endswith(b"\r\n") for line in lines[:-1])


def test_included_files_become_one_deck(tmp_path):
    """A card of an included file changes, and the files that were read stay as they are."""
    text = deck_text({})
    start, end = text.index("PCOMP"), text.index("GRID")
    deck, plies = tmp_path / "model.bdf", tmp_path / "plies.inc"
    deck.write_text(f"{text[:start]}INCLUDE 'plies.inc'\n{text[end:]}")
    plies.write_text(text[start:end].rstrip())
    body = moved(read(deck, "plate", 3))
    path = mbd.io.write_bdf(body, deck)
    same(body, read(path, "plate", 3))
    assert plies.read_text() == text[start:end].rstrip()
    with refused("path"):
        mbd.io.write_bdf(body, deck, plies)
    assert plies.read_text() == text[start:end].rstrip()
    plies.write_text(text[start:end])
    with refused("deck"):
        mbd.io.write_bdf(body, deck)


def test_pshell_and_nsm_follow_the_thickness(tmp_path):
    """A thickness of a PSHELL is written, NSM as the body has it, with a warning; heights of stresses follow."""
    deck = tmp_path / "model.bdf"
    shell = "PSHELL,7,2,3.-3,2,,,,.5\n,1.5-3,-1.5-3\nMAT1,2,7.+10,,.3,2700."
    text = deck_text({"PCOMP,7,,,,TSAI": "PCOMP,8,,.5,,TSAI"}).replace("GRID,1,", f"{shell}\nGRID,1,")
    deck.write_text(text.replace("CQUAD4,2,7", "CQUAD4,2,8"))
    body = read(deck, "plate", 3)
    with torch.no_grad():
        body.pcomp_8.thickness[0] *= 1.5
        body.pshell_7.thickness.mul_(0.7)
    with warned("NSM"):
        path = mbd.io.write_bdf(body, deck)
    same(body, read(path, "plate", 3))
    [card] = [card for card in read_cards(path) if card.name == "PSHELL"]
    assert (card.real(9, "Z1"), card.real(10, "Z2")) == pytest.approx((0.7 * 1.5e-3, -0.7 * 1.5e-3))


@pytest.mark.parametrize(
    ("material", "angle", "is_written"),
    [
        ("MAT1,2,7.+10,,.3,2700.", 0.1, True),  # a metal has no direction
        ("MAT1,2,7.+10,,.3,2700.,2.-5", 1.0, True),
        ("MAT1,2,7.+10,,.3,2700.,,,,\n,3.+8,3.+8,2.+8", 0.1, False),  # criteria of failure judge by directions
        ("MAT8,2,7.+10,5.+10,.3,2.+10,2.+10,2.+10,2700.", 0.1, False),
        ("MAT8,2,7.+10,5.+10,.3,2.+10,2.+10,2.+10,2700.", -1e-17, True),  # an optimizer leaves rounding
        ("MAT8,2,7.+10,5.+10,.3,2.+10,2.+10,2.+10,2700.", math.pi, True),
        ("MAT8,2,7.+10,7.+10,.3,2.+10,2.+10,2.+10,2700.", 0.1, False),
    ],
)
def test_a_pshell_has_no_angle(material, angle, is_written, tmp_path):
    """A design that turns its layer is written if the deck has the same body without the angle."""
    deck = tmp_path / "model.bdf"
    text = deck_text({"PCOMP,7,,,,TSAI": "PCOMP,8,,,,TSAI"})
    deck.write_text(
        text.replace("GRID,1,", f"PSHELL,7,2,3.-3,2\n{material}\nGRID,1,").replace("CQUAD4,2,7", "CQUAD4,2,8")
    )
    body = read(deck, "plate", 3)
    with torch.no_grad():
        body.pshell_7.angles.fill_(angle)
        body.pshell_7.thickness.mul_(0.7)
    if is_written:
        same(body, read(mbd.io.write_bdf(body, deck), "plate", 3))
    else:
        with refused("plate.pshell_7.turn", ANY, f"{math.degrees(angle):g}"):
            mbd.io.write_bdf(body, deck)


def test_a_global_ply_stack_is_written(tmp_path):
    """A PCOMPG keeps the numbers of its plies."""
    deck = tmp_path / "model.bdf"
    plies = "\n".join(f",{n},1,{t},{angle},YES,,," for n, t, angle in ((11, "1.-3", "20."), (12, "2.-3", "-50.")))
    text = deck_text({})
    deck.write_text(text[: text.index("PCOMP")] + f"PCOMPG,7,,,,TSAI\n{plies}\n" + text[text.index("GRID") :])
    body = read(deck, "plate", 3)
    with torch.no_grad():
        body.laminate.angles.copy_(ANGLES[:2])
    path = mbd.io.write_bdf(body, deck)
    same(body, read(path, "plate", 3))


@pytest.mark.thorough
def test_the_best_design_of_an_optimization_is_written(tmp_path):
    """The result has the design, its system keeps the numbers of before; a multistart has its best."""
    deck = tmp_path / "model.bdf"
    deck.write_text(deck_text({}))
    body = read(deck, "plate", 2)
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("spc_1"))], gravity=(0, 0, -9.81))
    energy = mbd.Integral(mbd.StrainEnergy("plate"))
    problem = mbd.Problem(system, 0.01, energy, steps=4, bounds=mbd.deg([-90, 90]))
    result = mbd.optimize(problem, max_iterations=1)
    assert not np.allclose(result.x, problem.start)
    path = mbd.io.write_bdf(result, deck)
    assert_close(read(path, "plate", 2).laminate.angles.detach(), torch.from_numpy(result.x), rtol=1e-11, atol=0)
    assert_close(body.laminate.angles.detach(), torch.from_numpy(problem.start))
    searches = mbd.optimization.multistart(problem, starts=[result.x], max_iterations=1)
    assert mbd.io.write_bdf(searches, deck, tmp_path / "best.bdf").is_file()
    assert mbd.io.write_bdf(system, deck, tmp_path / "start.bdf").read_text() == deck.read_text()


def test_bad_input_is_refused(tmp_path):
    """Another deck, the deck itself as target, a body of no deck, repeated cards, two designs of one card."""
    deck = tmp_path / "model.bdf"
    deck.write_text(deck_text({}))
    body = moved(read(deck, "plate", 3))
    with refused("path"):
        mbd.io.write_bdf(body, deck, deck)
    with refused("deck"):
        mbd.io.write_bdf(body, tmp_path / "none.bdf")
    with refused("design", 3.0):
        mbd.io.write_bdf(3.0, deck)
    rod = mbd.RigidBody("rod", 1.0, (1, 1, 1))
    with refused("design"):
        mbd.io.write_bdf(mbd.System([rod], free=["rod"]), deck)
    with refused("deck"):
        mbd.io.write_bdf(mbd.examples.arm(), deck)
    deck.write_text(deck.read_text().replace("1586.", "1587."))
    with refused("deck"):
        mbd.io.write_bdf(body, deck)


def test_a_repeated_card_is_refused(tmp_path):
    deck = tmp_path / "model.bdf"
    cards = "PSHELL,7,2,3.-3,2\n=,*(1),==\nMAT1,2,7.+10,,.3,2700.\n"
    text = deck_text({})
    deck.write_text(
        text[: text.index("PCOMP")] + cards + text[text.index("GRID") :].replace("CQUAD4,2,7", "CQUAD4,2,8")
    )
    body = read(deck, "plate", 3)
    for part in (body.pshell_7, body.pshell_8):
        with torch.no_grad():
            part.thickness.mul_(2.0)
        with pytest.raises(InputError, match=r"PSHELL [78] repeats another card"):
            mbd.io.write_bdf(body, deck)


def test_a_card_of_several_parts_needs_one_design(tmp_path):
    """Elements of two ZOFFS are two parts with parameters of their own."""
    deck = tmp_path / "model.bdf"
    deck.write_text(deck_text({"102,2,0.\n": "102,2,0.,1.-3\n"}))
    body = read(deck, "plate", 3)
    with torch.no_grad():
        body.pcomp_7.angles.copy_(ANGLES)
    with refused("PCOMP.7", ANY, "plate.pcomp_7", "plate.pcomp_7_offset_1"):
        mbd.io.write_bdf(body, deck)
    with torch.no_grad():
        body.pcomp_7_offset_1.angles.copy_(ANGLES)
    same(body, read(mbd.io.write_bdf(body, deck), "plate", 3))
