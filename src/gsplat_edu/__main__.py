"""`python -m gsplat_edu`: the command line, also for `torchrun -m gsplat_edu`."""

import sys

from gsplat_edu.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
