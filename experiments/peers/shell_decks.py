"""The largest complete shell decks of others that were found, from file to Craig-Bampton body, read unedited.
`python -m experiments.peers.shell_decks`

    battery_pack.bdf            of the repository smdogroup/tacs (TACS is its folder), written by Femap: nine cells in a block,
                                10,205 grids, 9,989 shells of ten properties, in meters
    nastran_input_geometry.inp  of mid2SUPAERO/StaticAeroelasticity-MDO-IACONO (CRM_WING is its folder), in free fields: the
                                wing of NASA's Common Research Model, 10,824 grids, 12,475 shells of 12 properties, 14,134 bars
                                with offsets of 6 properties, 20 masses, 120 equations
    large_shelled_beam_test.dat of MYSTRANsolver/MYSTRAN_Resources (MYSTRAN is its folder): a tube on an elastic mount, 25,329
                                grids, 25,200 shells of one property, two RBE3, a CBUSH

Interface: the nodes of shells that are nearest to the four corners of the box around all, at its upper side; the first of them
is the reference, if the deck holds no grid. Each deck is read in a process of its own. Printed:

    processor seconds and peak memory of reading, of the body, and of the derivative of its first frequency by a thickness
    mass of the shells      beside area x thickness x density of the cards, by a parser of its own
    first frequency         with the reference held, beside eigsh of SciPy of the same K and M without reduction
    its derivative          beside phi' (dK - lambda dM) phi with the vector phi of eigsh and differences of K and M; where
                            frequencies are equal, the derivative of their mean
"""

from __future__ import annotations

import math
import multiprocessing
import os
import resource
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import LinearOperator, eigsh, splu

import torchmbd as mbd
from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.fem.elements import Plates
from torchmbd.math.sparse import SparseMatrix

DECKS = {
    "TACS": Path("examples") / "battery" / "battery_pack.bdf",
    "CRM_WING": Path("Codes") / "test cases" / "Input Files" / "nastran_input_geometry.inp",
    "MYSTRAN": Path("MYSTRAN_Development") / "Actions_and_Bugs" / "large_shelled_beam_test.dat",
}
MODES = 20
EQUAL = 1e-3  # of frequencies that belong together, such as those of a round tube: their mean has a derivative
STEP = 1e-4  # of the thickness, in differences


def resident_mb() -> float:
    """Largest so far, of a process that a small one began."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def corners(mesh: mbd.Mesh) -> list[int]:
    """The nodes of shells that are nearest to the four corners of the box around all of these, at its upper side."""
    used = torch.cat([mesh.triangles.flatten(), mesh.quads.flatten()]).unique()
    nodes = mesh.nodes[used]
    low, high = nodes.amin(0), nodes.amax(0)
    places = [torch.stack([x, y, high[2]]) for x in (low[0], high[0]) for y in (low[1], high[1])]
    return [int(used[(nodes - place).norm(dim=1).argmin()]) for place in places]


def fields(line: str) -> list[str]:
    """Fields of a card in small or free fields."""
    if "," in line:
        return [field.strip() for field in line.split(",")]
    return [line[8 * k : 8 * k + 8].strip() for k in range(9)]


def real(text: str) -> float:
    """A number of Nastran, such as 7.+10; 0.0 of an empty field."""
    sign = max(text.rfind("+"), text.rfind("-"))
    if sign > 0 and text[sign - 1] not in "eEdD":
        text = f"{text[:sign]}e{text[sign:]}"
    return float(text.lower().replace("d", "e") or "0")


def mass_of_cards(path: Path) -> float:
    """Sum of area x (thickness x density + NSM) of CQUAD4 and CTRIA3 with PSHELL and MAT1, all in basic axes."""
    cards: dict[str, dict[str, list[str]]] = {}
    for line in path.read_text(encoding="latin-1").splitlines():
        card = [*fields(line), *[""] * 9]
        cards.setdefault(card[0].upper(), {})[card[1]] = card
    places = {name: np.array([real(x) for x in card[3:6]]) for name, card in cards["GRID"].items()}
    total = 0.0
    for name, count in (("CQUAD4", 4), ("CTRIA3", 3)):
        for card in cards.get(name, {}).values():
            x = [places[node] for node in card[3 : 3 + count]]
            area = 0.5 * float(np.linalg.norm(np.cross(x[2] - x[0], x[-1] - x[1])))
            shell = cards["PSHELL"][card[2]]
            total += area * (real(shell[3]) * real(cards["MAT1"][shell[2]][5]) + real(shell[8]))
    return total


def matrices(assembly: Any) -> tuple[scipy.sparse.csc_array, scipy.sparse.csc_array]:
    """K and M of the free degrees of freedom."""
    with torch.no_grad():
        K, M = assembly.stiffness(), assembly.mass()
    m = M.pattern.to_scipy(M.values) if isinstance(M, SparseMatrix) else scipy.sparse.diags_array(M.numpy())
    return scipy.sparse.csc_array(K.pattern.to_scipy(K.values)), scipy.sparse.csc_array(m)


def first_frequencies(k: scipy.sparse.csc_array, m: scipy.sparse.csc_array) -> tuple[np.ndarray, np.ndarray]:
    """The lowest frequency [Hz] with those that are equal to it, and their vectors of unit modal mass, by SciPy."""
    factor = splu(k, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    inverse = LinearOperator(k.shape, matvec=factor.solve, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    start = np.ones(len(k.indptr) - 1)
    squares, vectors = eigsh(k, 4, m, sigma=0.0, OPinv=inverse, v0=start)
    order = np.argsort(squares)
    hertz = np.sqrt(squares[order]) / (2.0 * math.pi)
    equal = hertz <= (1.0 + EQUAL) * hertz[0]
    return hertz[equal], vectors[:, order[equal]]


def derivative(assembly: Any, thickness: torch.Tensor, f: np.ndarray, vectors: np.ndarray) -> float:
    """The derivative of the mean of frequencies f [Hz] by a thickness [m]; the vectors do not change with it."""
    sides = []
    with torch.no_grad():
        nominal = thickness.clone()
        for factor in (1.0 + STEP, 1.0 - STEP):
            thickness.copy_(factor * nominal)
            sides.append(matrices(assembly))
            thickness.copy_(nominal)
    dk, dm = ((a - b) / (2.0 * STEP * float(nominal)) for a, b in zip(*sides, strict=True))
    squares = (2.0 * math.pi * f) ** 2
    slopes = (vectors * (dk @ vectors)).sum(0) - squares * (vectors * (dm @ vectors)).sum(0)
    return float((slopes / (8.0 * math.pi**2 * f)).mean())


def report(path: Path) -> str:
    """Read and reduce a deck; return the lines about it."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of cards that are left out
    start = time.process_time()
    deck = bulk_body(path)
    kept = corners(deck.mesh)
    reference = deck.reference or kept[:1]
    interface = [node for node in kept if node not in reference]
    read, before = time.process_time(), resident_mb()
    body = mbd.io.read_bdf(
        path, "deck", modes=MODES, reduction="craig-bampton", interface=interface, reference=reference
    )
    seconds, memory = time.process_time() - read, resident_mb() - before
    place = deck.mesh.nodes[reference[0]].tolist()
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(*place), body.at(reference[0]))])
    name, thickness = next((n, x) for n, x in body.named_parameters() if n.endswith("thickness") and x.numel() == 1)
    began = time.process_time()
    t = thickness.detach().clone()[None].requires_grad_()
    frequencies = mbd.equilibrium(system, designs={f"deck.{name}": t}).frequencies[0]
    ours = frequencies[frequencies <= (1.0 + EQUAL) * frequencies[0]]
    [slope] = torch.autograd.grad(ours.mean(), t)
    gradient, peak = time.process_time() - began, resident_mb()
    f, vectors = first_frequencies(*matrices(body.assembly))
    other = derivative(body.assembly, thickness, f, vectors)
    first, exact = float(ours[0]), float(f[0])
    shells = sum(float(part.masses().mass.sum()) for part in deck.parts.values() if isinstance(part, Plates))
    cards = mass_of_cards(path)
    return (
        f"{path.name}: {deck.mesh}; {len(body.assembly.freedoms.free):,} freedoms\n"
        f"reference {reference}, interface nodes {interface}\nread: {read - start:.1f} s of CPU\n"
        f"read and Craig-Bampton body of {body.modes} shapes: {seconds:.1f} s of CPU, {memory:.0f} MB\n"
        f"first frequency and its derivative by {name}: {gradient:.1f} s of CPU, {peak:.0f} MB in all\n"
        f"mass of the shells {shells:.8g}, by the cards {cards:.8g}: {shells / cards - 1:.1e}\n"
        f"first frequency ({len(ours)} equal) {first:.6g} Hz, by eigsh without reduction {exact:.6g} Hz ({len(f)}): "
        f"{first / exact - 1:.1e}\n"
        f"its derivative {float(slope):.6g} Hz/m, by eigsh and differences {other:.6g} Hz/m: {float(slope) / other - 1:.1e}"
    )


def main() -> None:
    """Print the lines of each deck whose folder is known."""
    for variable, path in DECKS.items():
        folder = os.environ.get(variable)
        if folder is None:
            print(f"{variable} is not the folder of its repository; {path.name} was not read")
            continue
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            print(pool.apply(report, [Path(folder) / path]))


if __name__ == "__main__":
    main()
