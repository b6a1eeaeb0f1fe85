"""`python -m stereo` is `stereo`."""

from __future__ import annotations

import sys

from stereo.cli import main

if __name__ == "__main__":
    sys.exit(main())
