"""What every test relies on: checked shapes, reproducible Hypothesis, no display, one thread per process."""

import os

# Before NumPy is imported: the matrices here are tiny, and two workers with thread pools only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

from hypothesis import settings
from jaxtyping import install_import_hook

# Before tolnet is imported: from here on each shape annotation of the package is enforced at run time.
install_import_hook(["tolnet"], "beartype.beartype")

settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "here")
