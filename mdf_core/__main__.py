"""``python -m mdf_core`` is the command ``mdf``."""

import sys

from mdf_core.cli import main

if __name__ == "__main__":
    sys.exit(main())
