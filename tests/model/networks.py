"""Networks of every kind for the tests of this folder, and what it means that two are the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy import sparse

from tolnet.model import DIFFUSION_RULES, Ambiguity, SensorNetwork

ARRAYS = ("A", "B", "Q", "C", "R", "D", "rows", "input", "initial_mean", "initial_covariance", "positions")
OTHERS = ("directed", "states", "dt", "names", "name", "description", "ambiguity")

labels = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=8)


def covariance(generator: np.random.Generator, n: int, rank: int | None = None) -> np.ndarray:
    """A random covariance of the given rank, symmetric to the last bit."""
    factor = generator.standard_normal((n, n if rank is None else rank))
    product = factor @ factor.T
    return (product + product.T) / 2 + (np.eye(n) if rank is None else 0)


@st.composite
def arguments(draw: st.DrawFn) -> dict[str, Any]:
    """What the constructor takes: relays, mixed p_k, R beside D, one-way links, W or a rule."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, N = draw(st.integers(1, 4)), draw(st.integers(1, 6))
    same = draw(st.booleans())
    sizes = [draw(st.integers(0, 3))] * N if same else draw(st.lists(st.integers(0, 3), min_size=N, max_size=N))
    by_factor = draw(st.sampled_from(["R", "D", "both"]))
    factored = [by_factor == "D" or (by_factor == "both" and draw(st.booleans())) for _ in sizes]
    values: dict[str, Any] = {
        "A": generator.standard_normal((n, n)) * draw(st.sampled_from([1.0, 1e-200, 1e200])),
        "C": [generator.standard_normal((p, n)) for p in sizes],
        "R": [None if d else covariance(generator, p) for d, p in zip(factored, sizes, strict=True)],
        "D": [covariance(generator, p) if d else None for d, p in zip(factored, sizes, strict=True)],
    }
    if draw(st.booleans()):
        values["B"] = generator.standard_normal((n, draw(st.integers(0, n))))
    else:
        values["Q"] = covariance(generator, n, draw(st.integers(0, n)))
    linked = generator.random((N, N)) < 0.5
    values["directed"] = draw(st.booleans())
    if not values["directed"]:
        linked = np.triu(linked, 1)
    values["edges"] = np.argwhere(linked & ~np.eye(N, dtype=bool))
    W = weights(linked, values["directed"], generator)
    optional = {
        "input": lambda: generator.standard_normal(n),
        "initial_mean": lambda: draw(st.sampled_from([-0.0, 1.0, 5e-324])) * np.ones(n),
        "initial_covariance": lambda: covariance(generator, n),
        "states": lambda: draw(st.lists(labels, min_size=n, max_size=n)),
        "dt": lambda: float(generator.random() + 0.1),
        "positions": lambda: generator.standard_normal((N, draw(st.sampled_from([2, 3])))),
        "names": lambda: draw(st.lists(labels, min_size=N, max_size=N, unique=True)),
        "name": lambda: draw(labels),
        "description": lambda: draw(labels) + "\nand more: [1,\n  2,\n] \"quoted\" 'too'",
        "ambiguity": lambda: draw(ambiguities),
        "diffusion": lambda: draw(st.sampled_from([*DIFFUSION_RULES, W])),
    }
    return values | {key: make() for key, make in optional.items() if draw(st.booleans())}


TOLERANCES = st.just(0.0) | st.floats(1e-200, 1e10)
ambiguities = st.one_of(
    st.builds(Ambiguity, TOLERANCES, st.sampled_from(["gamma", "nats"])),
    st.builds(Ambiguity, TOLERANCES, st.just("gamma"), st.floats(0, 1)),
)


def weights(linked: np.ndarray, directed: bool, generator: np.random.Generator) -> np.ndarray:
    """A random W on a graph."""
    heard = linked | np.eye(len(linked), dtype=bool)
    W = np.where(heard if directed else heard | heard.T, generator.random(linked.shape) + 0.1, 0.0)
    return W / W.sum(axis=0)


def assert_same(one: SensorNetwork, other: SensorNetwork) -> None:
    """Two networks agree to the last bit, signs of zeros included; only their digests may differ."""
    for key in ARRAYS:
        a, b = getattr(one, key), getattr(other, key)
        assert (a is None) == (b is None), key
        if a is not None:
            assert a.shape == b.shape, key
            assert a.dtype == b.dtype, key
            assert a.tobytes() == b.tobytes(), key
    for key in OTHERS:
        assert getattr(one, key) == getattr(other, key), key
    assert_same_sparse(one.adjacency, other.adjacency)
    if isinstance(one.diffusion, str) or isinstance(other.diffusion, str):
        assert one.diffusion == other.diffusion
    else:
        assert_same_sparse(one.diffusion, other.diffusion)


def assert_same_sparse(one: sparse.csr_array, other: sparse.csr_array) -> None:
    """Two sparse matrices agree in pattern and, to the last bit, in values."""
    assert one.shape == other.shape
    assert np.array_equal(one.indptr, other.indptr)
    assert np.array_equal(one.indices, other.indices)
    assert one.data.tobytes() == other.data.tobytes()
