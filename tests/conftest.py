"""What every test relies on: checked shapes, reproducible Hypothesis, no display, one thread per process."""

import os

# Before NumPy is imported: the matrices here are tiny, and two workers with thread pools only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from tests import checked_shapes, study

# Before tolnet is imported: from here on the shape annotations of the package are enforced at run time.
checked_shapes.install("tolnet")
study.load_hypothesis_profile()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """The first calls of every function are checked in each test."""
    checked_shapes.next_test()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of the study are for TOLNET_STUDY=full, the others for always."""
    if not study.FULL:
        left = [item for item in items if item.get_closest_marker("study")]
        items[:] = [item for item in items if not item.get_closest_marker("study")]
        config.hook.pytest_deselected(items=left)
