"""All eight plate strains of the laminated triangle, from the six freedoms of its corners in mesh axes.

    (eps_xx, eps_yy, gamma_xy, kappa_xx, kappa_yy, kappa_xy, gamma_xz, gamma_yz) = E (u1 u2 u3 phi1 phi2 phi3) x 3

in the laminate's axes (facet.py), at the middles of the sides 12, 23, 31. Membrane: OPT with drilling freedoms;
bending and transverse shear: DKMT. Flat triangles in space: the local freedoms are the global ones turned by `axes`.

Between facets that are tilted to each other, a bending rotation of one is partly a drilling rotation of its neighbour.
That is as stiff as a membrane, so thin curved shells would lock: by membrane over bending stiffness, a ratio of about

    r = (tilt sqrt(2 area) / h)^2        h = bending_length of the laminate, its thickness if it is homogeneous

The drilling freedoms are softened by r where r is not small (opt_membrane.py). A flat plate has r = 0; on a curved shell
r falls with the fourth power of the mesh size, so the limit is the same.
Checked in tests/elements/test_plate_patch.py, tests/validation/test_curved_shells.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.dkmt_bending import plate_strains
from torchmbd.elements.facet import Facets
from torchmbd.elements.opt_membrane import membrane_strains
from torchmbd.materials import IsotropicMean

#: Freedoms of a corner, in this order, in every vector of torchmbd: displacements [m], rotations [rad].
FREEDOMS = ("u1", "u2", "u3", "phi1", "phi2", "phi3")


def strain_matrices(plane: Facets, mean: IsotropicMean) -> Float[Tensor, "m 3 8 18"]:
    """Return E of every triangle at its three points."""
    softness = 2.0 * plane.area * (plane.tilt / mean.bending_length) ** 2
    membrane = membrane_strains(plane.corners, plane.area, mean.poisson, softness)
    curvature, shear = plate_strains(plane.corners, plane.area, mean.shear_length, plane.cell)
    local = membrane.new_zeros(len(plane.area), 3, 8, 3, 6)
    local[:, :, :3, :, [0, 1, 5]] = membrane.unflatten(-1, (3, 3))
    bending = torch.cat([curvature, shear], dim=2).unflatten(-1, (3, 3))
    local[:, :, 3:, :, 2] = bending[..., 0]
    local[:, :, 3:, :, 4] = bending[..., 1]  # beta_x = phi_y
    local[:, :, 3:, :, 3] = -bending[..., 2]  # beta_y = -phi_x
    vectors = local.unflatten(-1, (2, 3))  # a displacement and a rotation at every corner
    return torch.einsum("mpscvi,mij->mpscvj", vectors, plane.axes).reshape(-1, 3, 8, 18)
