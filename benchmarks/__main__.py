"""Run the benchmarks that are named on the command line, or all of them.

On one BLAS thread, unless OPENBLAS_NUM_THREADS says otherwise: CPU time then is time spent computing, and not that of
threads which wait for one another, on either side of a comparison.
"""

from __future__ import annotations

import argparse
import importlib
import os
from pathlib import Path

THREADS = "OPENBLAS_NUM_THREADS"

NAMES = sorted(
    path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in ("__init__", "__main__", "harness")
)


def main() -> None:
    """`python -m benchmarks [NAME ...]`."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of: {', '.join(NAMES)} (default: all)")
    names = parser.parse_args().names or NAMES
    unknown = sorted(set(names) - set(NAMES))
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(NAMES)}")
    os.environ.setdefault(THREADS, "1")  # read once, when NumPy is imported
    print(f"{THREADS}={os.environ[THREADS]}")
    for name in names:
        importlib.import_module(f"benchmarks.{name}").run()


if __name__ == "__main__":
    main()
