"""What every test relies on: checked shapes, reproducible Hypothesis, no display, one thread per process."""

import os

# Before NumPy is imported: the matrices here are tiny, and two workers with thread pools only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from tests import checked_shapes, study

# Before tolnet is imported: from here on the shape annotations of the package are enforced at run time.
checked_shapes.install("tolnet")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fast", action="store_true", help="each test once, with one set of parameters; none marked slow"
    )


def pytest_configure(config: pytest.Config) -> None:
    study.load_hypothesis_profile(fast=bool(config.getoption("--fast")))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """The first calls of every function are checked in each test."""
    checked_shapes.next_test()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of the study are for TOLNET_STUDY=full; slow ones and further sets of parameters not for --fast."""
    fast, seen = config.getoption("--fast"), set[tuple[object, str]]()
    kept, left = [], []
    for item in items:
        function = (item.parent, getattr(item, "originalname", item.name))
        wanted = study.FULL or not item.get_closest_marker("study")
        if fast:
            wanted = wanted and function not in seen and not item.get_closest_marker("slow")
            seen.add(function)
        (kept if wanted else left).append(item)
    items[:] = kept
    config.hook.pytest_deselected(items=left)
