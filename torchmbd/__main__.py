"""`python -m torchmbd` is the command `torchmbd`."""

import sys

from torchmbd.cli import main

sys.exit(main())
