"""What every test relies on: checked shapes, reproducible Hypothesis, no display, one thread per process."""

import os
from pathlib import Path

# Before NumPy is imported: the matrices here are tiny, and two workers with thread pools only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from tests import checked_shapes, study

# Before tolnet is imported: from here on the shape annotations of the package are enforced at run time.
checked_shapes.install("tolnet")

ROOT = Path(__file__).parent
LONG = {
    *(f"analysis/test_{name}.py" for name in (
        "against_oracles", "corrupted_simulation", "data", "detectability", "drkf_steady_state", "error_dynamics",
        "extended", "filters", "hard_networks", "limits", "lyapunov", "no_answer", "simulation",
    )),
    *(f"certificates/test_{name}.py" for name in (
        "alterations", "ball_convergence", "check_filters", "hostile", "soundness",
    )),
    *(f"cli/test_{name}.py" for name in (
        "certify", "certify_channels", "channels", "diffusion", "documented", "extremes", "forgeries", "hints",
        "hostile_inputs", "malformed_certificates", "observability", "performance", "process", "simulate",
    )),
    *(f"design/{name}.py" for name in (
        "test_window", "weights/test_decay", "weights/test_mixing", "weights/test_optimise",
    )),
    *(f"model/test_{name}.py" for name in ("bounded_reading", "corrupted_files", "fuzz")),
    *("reference/test_oracles.py", "report/test_map.py"),
}  # fmt: skip
"""Modules that --fast leaves out: searches and proofs of whole networks. What they stand on has its own tests."""


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
            long = item.get_closest_marker("slow") or item.path.relative_to(ROOT).as_posix() in LONG
            wanted = wanted and function not in seen and not long
            seen.add(function)
        (kept if wanted else left).append(item)
    items[:] = kept
    config.hook.pytest_deselected(items=left)
