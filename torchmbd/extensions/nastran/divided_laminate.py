"""A shell of one layer whose membrane, bending and transverse shear have materials of their own (PSHELL of Nastran).

    A = t Q_A      D = t^3 / 12 Q_D + e^2 A      B = e A      As = t G

e: offset of the middle from the surface of the nodes. Q_A, Q_D, G: in the axes of the layer, turned by its angle. There is no
layer with these stiffnesses, so there are no ply stresses.
Checked in tests/extensions/nastran/test_shells.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.laminate import Laminate, LaminateStiffness, turned_stiffness
from torchmbd.fem.materials.ply import Ply
from torchmbd.fem.materials.transverse_shear import ShearShape


class DividedLaminate(Laminate):
    """Parameters `.angles` [1] [rad] and `.thickness` [1] [m].

    ply        of its density
    membrane   Q_A [3, 3], bending Q_D [3, 3], shear G [2, 2] [Pa]: of stresses xx, yy, xy and xz, yz
    """

    membrane: Tensor
    bending: Tensor
    shear: Tensor

    def __init__(
        self,
        ply: Ply,
        thickness: float,
        membrane: Float[Tensor, "3 3"],
        bending: Float[Tensor, "3 3"],
        shear: Float[Tensor, "2 2"],
        offset: float = 0.0,
    ) -> None:
        super().__init__(ply, [0.0], thickness, shear_correction=1.0, offset=offset)
        for name, x in (("membrane", membrane), ("bending", bending), ("shear", shear)):
            if not float(torch.linalg.eigvalsh(x)[0]) > 0.0:
                raise InputError(
                    (name,),
                    allowed="the stiffness of an elastic material",
                    state=f"{x.tolist()} is not positive definite",
                    noun=f"{name} stiffness",
                )
            self.register_buffer(name, x, persistent=False)

    @property
    def merge_key(self) -> tuple:
        """Unique: it is not merged with other laminates."""
        return (id(self),)

    def stiffness(self) -> LaminateStiffness:
        """See the module header."""
        Q, G = torch.stack([self.membrane, self.bending]), self.shear.expand(2, 2, 2)
        return self._of_materials(*turned_stiffness(self.angles.expand(*self.angles.shape[:-1], 2), Q, G))

    def isotropic_stiffness(self) -> LaminateStiffness:
        """The same at the angle zero, of the same mean over all directions."""
        return self._of_materials(torch.stack([self.membrane, self.bending]), self.shear.expand(2, 2, 2))

    def _of_materials(self, Q: Tensor, G: Tensor) -> LaminateStiffness:
        """Of the materials of membrane and bending, in plate axes."""
        t, e = self.thickness[..., None], self.offset
        A, D = t * Q[..., 0, :, :], t**3 / 12.0 * Q[..., 1, :, :]
        return LaminateStiffness(A, e * A, D + e**2 * A, t * G[..., 0, :, :])

    def shear_shape(self) -> ShearShape:
        """InputError: membrane and bending are those of different materials."""
        raise InputError(
            "laminate",
            allowed="must have a stack of plies",
            noun="a shell whose membrane and bending have materials of their own",
            state="has no plies",
        )
