"""All decks of a repository of Nastran models, read one after the other. `python -m experiments.peers.nastran_decks`

PYNASTRAN_MODELS is the folder `models` of SteveDoyle2/pyNastran, whose .bdf files were made by many programs and people, to
test a reader of cards: heat, fluids, superelements and single cards without a model are among them. Printed: how many make a
body, and why the others do not. Materials without RHO get a density.
"""

from __future__ import annotations

import os
import re
import warnings
from collections import defaultdict
from pathlib import Path

from experiments.peers.wing_body import VARIABLE
from torchmbd.errors import InputError
from torchmbd.extensions.nastran.body import bulk_body

#: What a message has, and what it means; the first that fits counts.
REASONS = (
    (r"begins a superelement", "superelements"),
    (r"INCLUDE of", "INCLUDE of a file that is not there, or outside of the folder"),
    (r"disconnected parts", "several structures in one file (contact, glue, fluid)"),
    (r"^(\w+) .*cannot be read", "card: "),
    (r"of single components", "card: CMASS1, CMASS2 at grids"),
    (r"no elements that can be read", "no elements of a structure"),
    (r"does not exist", "grid, property or material that is not there (of heat, of p-elements, fragments)"),
    (r"is '%", "a template with words for numbers"),
    (r"scalar point", "spring between a grid and a scalar point"),
)


def reason(message: str) -> str:
    """In a few words."""
    for pattern, words in REASONS:
        match = re.search(pattern, message)
        if match:
            return words + match[1] if words.endswith(": ") else words
    return "other fields"


def main() -> None:
    """Read and print."""
    folder = os.environ.get(VARIABLE)
    if folder is None:
        print(f"{VARIABLE} is not the folder models of the repository SteveDoyle2/pyNastran; nothing was run")
        return
    files, refused = sorted(Path(folder).rglob("*.bdf")), defaultdict(list)
    for file in files:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                bulk_body(file, density=1.0)
        except InputError as error:
            refused[reason(str(error))].append(file.name)
    print(f"{len(files)} decks: {len(files) - sum(map(len, refused.values()))} are read; not read:")
    for words, names in sorted(refused.items(), key=lambda item: (-len(item[1]), item[0])):
        print(f"{len(names):5}  {words}")


if __name__ == "__main__":
    main()
