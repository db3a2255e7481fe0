"""What every test relies on: checked shapes, reproducible Hypothesis, no display, one thread per process."""

import os

# Before NumPy is imported: the matrices here are tiny, and two workers with thread pools only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from hypothesis import settings
from tests import checked_shapes

# Before tolnet is imported: from here on the shape annotations of the package are enforced at run time.
checked_shapes.install("tolnet")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """The first calls of every function are checked in each test."""
    checked_shapes.next_test()


settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "here")
