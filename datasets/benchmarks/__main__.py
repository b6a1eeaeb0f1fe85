"""`python -m datasets.benchmarks KIND SOURCE OUT`: writes a set's truth as a COLMAP model, to compare against."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from datasets.benchmarks import READERS
from sfm.core.errors import SfmError
from sfm.io.colmap_model import write_model


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m datasets.benchmarks", description=__doc__)
    parser.add_argument("kind", choices=sorted(READERS))
    parser.add_argument("source", type=Path, help="the file or folder of the truth")
    parser.add_argument("out", type=Path, help="folder of the COLMAP model, made if it is not there")
    options = parser.parse_args(arguments)
    try:
        truth = READERS[options.kind](options.source)
        options.out.mkdir(parents=True, exist_ok=True)
        write_model(truth, options.out)
    except SfmError as error:
        print(f"error: {error}", file=sys.stderr)
        return int(error.exit_code)
    print(f"{len(truth.image_names)} images, {len(truth.cameras)} cameras -> {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
