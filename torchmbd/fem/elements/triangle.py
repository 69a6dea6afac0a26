"""The laminated triangle: OPT membrane with drilling freedoms, DKMT bending and transverse shear.

Strains at the middles of the sides 12, 23, 31, each with a third of the area (strains.py tells their order).

Between facets that are tilted to each other, a bending rotation of one is partly a drilling rotation of its neighbour.
That is as stiff as a membrane, so thin curved shells would lock: by membrane over bending stiffness, a ratio of about

    r = (tilt sqrt(2 area) / h)^2        h = bending_length of the laminate, its thickness if it is homogeneous

The drilling freedoms are softened by r where r is not small (opt_membrane.py). A flat plate has r = 0; on a curved shell
r falls with the fourth power of the mesh size, so the limit is the same.
Checked in tests/contracts/test_shell_elements.py, tests/fem/elements/test_plate_patch.py,
tests/validation/test_curved_shells.py.
"""

from __future__ import annotations

from torchmbd.fem.elements.dkmt_bending import plate_strains
from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.opt_membrane import membrane_strains
from torchmbd.fem.elements.strains import Strains, in_mesh_axes
from torchmbd.fem.materials import IsotropicMean


def triangle_strains(plane: Facets, mean: IsotropicMean) -> Strains:
    """Return the strains of every triangle at its three points."""
    mean = mean.of_cells(len(plane.area))
    softness = 2.0 * plane.area * (plane.tilt / mean.bending_length) ** 2
    membrane = membrane_strains(plane.corners, plane.area, mean.poisson, softness, plane.mixed)
    curvature, shear = plate_strains(plane.corners, plane.area, mean.shear_length, plane.side_area, plane.mixed)
    at = in_mesh_axes(plane.axes, membrane.unflatten(-1, (3, 3)), curvature, shear)
    return Strains(at, (plane.area / 3.0)[:, None].expand(-1, 3), at.mean(1))
