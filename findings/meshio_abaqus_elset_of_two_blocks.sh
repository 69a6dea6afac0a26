#!/usr/bin/env bash
# meshio 5.3.5, Abaqus input: ELSET on the *ELEMENT line.
#
# A good guess: *ELEMENT, ELSET=SKIN puts the elements of its block into SKIN, a second block of this name adds its own, and a block
# without ELSET is in no set: cell_sets["SKIN"][k] has the members that lie in block k of mesh.cells.
#
# What happens, without a warning:
#   blocks of two quads and of one quad, both SKIN    the first block has the members of the second: its other quad is in no set
#   a block without ELSET before one with SKIN        the set is one block early: the unnamed quad is in it, its own quad is not
# Plies that are given to sets of a laminated shell then lie on other elements than the file says. Blocks that each have a name of
# their own are right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check meshio==5.3.5 numpy==2.4.6
nodes='*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 2., 0., 0.
4, 3., 0., 0.
5, 0., 1., 0.
6, 1., 1., 0.
7, 2., 1., 0.
8, 3., 1., 0.'
first='1, 1, 2, 6, 5' second='2, 2, 3, 7, 6' third='3, 3, 4, 8, 7'
skin='*ELEMENT, TYPE=S4, ELSET=SKIN' rib='*ELEMENT, TYPE=S4, ELSET=RIB' unnamed='*ELEMENT, TYPE=S4'
printf '%s\n' "$nodes" "$skin" "$first" "$second" "$skin" "$third" > "$folder/twice.inp"
printf '%s\n' "$nodes" "$unnamed" "$first" "$skin" "$second" > "$folder/unnamed.inp"
printf '%s\n' "$nodes" "$skin" "$first" "$second" "$rib" "$third" > "$folder/own.inp"
cat > "$folder/read.py" <<'PYTHON'
import sys

import meshio

for name in ("own", "twice", "unnamed"):
    mesh = meshio.read(f"{sys.argv[1]}/{name}.inp")
    members = {key: [cells.tolist() for cells in sets] for key, sets in sorted(mesh.cell_sets.items())}
    print(name, [len(cells.data) for cells in mesh.cells], members)
PYTHON
seen=$("$folder/venv/bin/python" "$folder/read.py" "$folder")
expected="own [2, 1] {'RIB': [[], [0]], 'SKIN': [[0, 1], []]}
twice [2, 1] {'SKIN': [[0], [0]]}
unnamed [1, 1] {'SKIN': [[0], []]}"
# A good guess has {'SKIN': [[0, 1], [0]]} for twice and {'SKIN': [[], [0]]} for unnamed.
printf '%s\n' "$seen"
diff <(printf '%s\n' "$expected") <(printf '%s\n' "$seen") && echo "as written above"
