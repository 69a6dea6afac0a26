#!/usr/bin/env bash
# openTorsion 0.3.2, Shaft: stiffness and inertia as numbers, or length and diameter.
#
# A good guess: Shaft(k=..., I=...) is the shaft whose stiffness is k [N m/rad] and whose moment of inertia is I [kg m^2], as its
# help says. The same shaft by length and diameter, k = G J/L and I = rho J L, has the same frequencies.
#
# What happens, without a warning: the shaft by numbers has six times the inertia. Its consistent mass matrix is I [[2, 1], [1, 2]],
# whose sum is 6 I; the shaft by length and diameter has I/6 in this place. Hand over I/6 where a shaft is given by numbers; a file
# of shafts with their inertias (a list of an engine's maker) has to be divided, too. Disks have the inertia that they are given.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check opentorsion==0.3.2 numpy==2.4.6 scipy==1.17.1
cat > "$folder/shaft.py" <<'PYTHON'
import math

import numpy as np
import opentorsion

LENGTH, DIAMETER, G, DENSITY, DISK = 0.8, 0.05, 80e9, 8000.0, 0.05  # SI
J = math.pi * DIAMETER**4 / 32
K, I = G * J / LENGTH, DENSITY * J * LENGTH
shafts = {
    "by length and diameter": opentorsion.Shaft(0, 1, L=1e3 * LENGTH, odl=1e3 * DIAMETER, G=G, rho=DENSITY),
    "by k and I": opentorsion.Shaft(0, 1, k=K, I=I),
    "by k and I/6": opentorsion.Shaft(0, 1, k=K, I=I / 6),
}
for name, shaft in shafts.items():
    system = opentorsion.Assembly([shaft], disk_elements=[opentorsion.Disk(0, DISK), opentorsion.Disk(1, DISK)])
    inertia = np.sum(system.assemble_M()) - 2 * DISK
    squares = np.abs(system.undamped_modal_analysis()[0])
    print(f"{name}: inertia {inertia / I:.3f} I, {math.sqrt(squares.max()) / (2 * math.pi):.2f} Hz")
# Two disks that turn against each other, with the linear element of the shaft: k (1 - -1)^2 / (2 DISK + I/3).
print(f"closed form: {math.sqrt(4 * K / (2 * DISK + I / 3)) / (2 * math.pi):.2f} Hz")
PYTHON
seen=$("$folder/venv/bin/python" "$folder/shaft.py")
expected="by length and diameter: inertia 1.000 I, 247.72 Hz
by k and I: inertia 6.000 I, 240.09 Hz
by k and I/6: inertia 1.000 I, 247.72 Hz
closed form: 247.72 Hz"
# A good guess has 1.000 I and 247.72 Hz in each line.
printf '%s\n' "$seen"
diff <(printf '%s\n' "$expected") <(printf '%s\n' "$seen") && echo "as written above"
