"""`python -m torchmbd` is the command `torchmbd`."""

from torchmbd.cli import main

main()
