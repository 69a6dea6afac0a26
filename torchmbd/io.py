"""Readers and writers of files of other programs, each of an extension: Nastran, meshes, matrices, robots, blades, ply books.

>>> mbd.io.read_mesh.__module__  # of the extension that has it
'torchmbd.extensions.meshes.reader'
"""

from typing import TYPE_CHECKING, Any

from torchmbd.registry import public, public_names

if TYPE_CHECKING:
    from torchmbd.extensions.beamdyn import read_beamdyn as read_beamdyn
    from torchmbd.extensions.matrices import read_matrix as read_matrix
    from torchmbd.extensions.meshes import read_mesh as read_mesh
    from torchmbd.extensions.nastran import read_bdf as read_bdf
    from torchmbd.extensions.nastran import write_bdf as write_bdf
    from torchmbd.extensions.ply_book import write_ply_book as write_ply_book
    from torchmbd.extensions.robots import read_mjcf as read_mjcf
    from torchmbd.extensions.robots import read_urdf as read_urdf
    from torchmbd.extensions.shell_models import write_model as write_model
    from torchmbd.extensions.windio import read_windio as read_windio

__all__: list[str] = []  # all are of extensions


def __getattr__(name: str) -> Any:
    """Import the extension of a reader or writer at the first access."""
    return public(f"io.{name}")


def __dir__() -> list[str]:
    special = [name for name in globals() if name.startswith("__")]
    return [*special, *(x.removeprefix("io.") for x in public_names() if x.startswith("io."))]
