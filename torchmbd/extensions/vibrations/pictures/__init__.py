"""Pictures of vibrations: Campbell diagrams, root loci, shapes as motions; at `mbd.viz`."""

from torchmbd.extensions.vibrations.pictures.mode_motion import animate_mode, mode_motion
from torchmbd.extensions.vibrations.pictures.spectra import campbell, root_locus

__all__ = ["animate_mode", "campbell", "mode_motion", "root_locus"]
