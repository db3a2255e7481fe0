"""Every condition of check.py turns from true to false where the formulas of docs/certificate.md do.

Nothing here is a solution of anything: the matrices of the proofs are drawn at random, the number at which the
condition starts to hold is computed from the formula, and the checker is asked on both sides of it.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from scipy.linalg import solve_discrete_lyapunov
from tests.reference import certificates as maker
from tests.reference.certificates import BLOCKS, Document, Numbers, document, scalar_data, text, triangle

from tolnet.certificates.check import check

CLOSE = 1e-7


def result(data: Document, claim: Document) -> str:
    return check(document(data, claim))[0].result


def definite(rng: np.random.Generator, n: int) -> ndarray:
    L = rng.normal(size=(n, n)) + 2 * np.eye(n)
    return L @ L.T


def networks(seed: int) -> tuple[np.random.Generator, Document]:
    """Undirected, directed, with a relay, with a negative weight, in turn."""
    rng = np.random.default_rng(seed)
    kind: dict[str, Any] = [
        {"neighbours": maker.ring(4)},
        {"neighbours": maker.one_way(4), "directed": True},
        {"neighbours": maker.path(4), "relays": (2,), "factors": True, "columns": 2},
        {"neighbours": maker.path(4), "negative": True, "columns": 0},
    ][seed % 4]
    return rng, maker.random_data(rng, 2, **kind, tilt=0.3)


def largest(image: ndarray, X: ndarray) -> float:
    """The least s with s X - image >= 0."""
    return float(np.linalg.eigvals(np.linalg.solve(X, image)).real.max())


def decay(rate: float, block: str, proof: Document) -> Document:
    said = maker.said_stable(block, rate)
    claim = {"claim": "decay-rate", "block": block, "verdict": "proved", "statement": said, "margin": 0.25}
    return {**claim, "reason": None, "rate": rate.hex(), "proof": proof}


def by_powers(at: Numbers, j: int, X: list[ndarray], rng: np.random.Generator) -> tuple[Document, list[float]]:
    """Random shares for all paths of j links, and what every node needs."""
    n, N = at.n, at.N
    power, reach = np.eye(N * n), np.eye(N, dtype=int)
    for _ in range(j):
        power, reach = power @ at.network, reach @ (at.W != 0)
    shares, needed = [], []
    for k in range(N):
        reached = [l for l in range(N) if reach[l, k]]
        p = rng.uniform(0.1, 1, len(reached))
        p *= 0.9 / p.sum()
        blocks = [power[k * n : (k + 1) * n, l * n : (l + 1) * n] for l in reached]
        terms = [B @ X[l] @ B.T / share for B, l, share in zip(blocks, reached, p, strict=True)]
        shares.append(text(p))
        needed.append(largest(np.sum(terms, axis=0), X[k]))
    return {"method": "power", "power": j, "X": [triangle(x) for x in X], "shares": shares}, needed


def needs(method: str, at: Numbers, rng: np.random.Generator) -> tuple[Document, list[float], int]:
    """A random proof, the least s for every condition, and the power of the rate that s has."""
    X = [definite(rng, at.n) for _ in range(at.N)]
    texts = [triangle(x) for x in X]
    sigma, W, M = at.sigma, abs(at.W), at.M
    if method == "primal":
        moved = [M[l] @ X[l] @ M[l].T for l in range(at.N)]
        images = [sigma[k] * sum(W[l, k] * moved[l] for l in range(at.N)) for k in range(at.N)]
        return {"method": method, "X": texts}, list(map(largest, images, X)), 2
    if method == "dual":
        images = [M[l].T @ sum(sigma[k] * W[l, k] * X[k] for k in range(at.N)) @ M[l] for l in range(at.N)]
        return {"method": method, "Y": texts}, list(map(largest, images, X)), 2
    if method == "full":
        whole = definite(rng, at.n * at.N)
        return {"method": method, "X": triangle(whole)}, [largest(at.network @ whole @ at.network.T, whole)], 2
    return *by_powers(at, int(method[-1]), X, rng), 2 * int(method[-1])


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("method", ["primal", "dual", "full", "power 2", "power 3"])
@pytest.mark.parametrize("seed", range(4))
def test_the_rate_that_a_proof_reaches(seed: int, method: str, block: str) -> None:
    rng, data = networks(seed)
    at = Numbers(data)
    proof, needed, exponent = needs(method, at, rng)
    least = (max(needed) / 0.75) ** (1 / exponent)
    if block == "F":
        X = definite(rng, at.n)
        proof["centre"] = triangle(X)
        least = max(least, (largest(at.Fe @ X @ at.Fe.T, X) / 0.75) ** 0.5)
    assert result(data, decay(least * (1 + CLOSE), block, proof)) == "valid"
    assert result(data, decay(least * (1 - CLOSE), block, proof)) == "invalid"


def test_the_centre_alone_decides_where_it_is_the_slowest() -> None:
    data = maker.random_data(np.random.default_rng(5), 2, maker.path(3), radius=0.3, columns=2, tilt=3.0)
    at = Numbers(data)
    rng = np.random.default_rng(1)
    proof, needed, exponent = needs("full", at, rng)
    X = definite(rng, at.n)
    proof["centre"] = triangle(X)
    least = (largest(at.Fe @ X @ at.Fe.T, X) / 0.75) ** 0.5
    assert (max(needed) / 0.75) ** (1 / exponent) < 0.9 * least
    assert result(data, decay(least * (1 + CLOSE), "F", proof)) == "valid"
    assert result(data, decay(least * (1 - CLOSE), "F", proof)) == "invalid"


# ---- Switching ----


def switching(margin: float, Y: list[ndarray], **keys: Any) -> Document:
    claim = {"claim": "switching", "verdict": "proved", "margin": margin, "reason": None, **keys}
    return {**claim, "statement": maker.said_switching(keys), "proof": {"Y": [triangle(y) for y in Y]}}


def without(at: Numbers, W: ndarray, G: list[dict[int, ndarray]], links: Any) -> tuple[ndarray, list[ndarray]]:
    """W and the loops that are left."""
    W, G = W.copy(), [dict(g) for g in G]
    for l, k in links:
        for j, hearer in [(l, k)] if at.directed else [(l, k), (k, l)]:
            W[hearer, hearer] += W[j, hearer]
            W[j, hearer] = 0
            G[hearer].pop(j)
    return W, at.loops(G)


def dual_needs(Y: list[ndarray], W: ndarray, M: list[ndarray]) -> list[float]:
    sigma, N = abs(W).sum(axis=0), len(M)
    images = [M[l].T @ sum(sigma[k] * abs(W[l, k]) * Y[k] for k in range(N)) @ M[l] for l in range(N)]
    return list(map(largest, images, Y))


@pytest.mark.parametrize("directed", [False, True])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["drop 1", "drop 2", "links", "weights", "gains", "both", "none"])
def test_the_margin_that_switching_reaches(kind: str, seed: int, directed: bool) -> None:
    rng = np.random.default_rng(seed)
    neighbours = [sorted({k, (k + 1) % 4, (k + 2) % 4}) for k in range(4)] if directed else maker.ring(4)
    data = maker.random_data(rng, 2, neighbours, directed=directed, radius=0.15)
    other = maker.random_data(rng, 2, neighbours, directed=directed, radius=0.4)
    at = Numbers(data)
    Y = [np.eye(2) + 0.1 * definite(rng, 2) for _ in range(4)]
    links = [(l, k) for k in range(4) for l in neighbours[k] if (l != k if directed else l < k)]
    nominal = dual_needs(Y, at.W, at.M)
    keys: Document
    if kind.startswith("drop"):
        most = int(kind[-1])
        keys = {"drop": most}
        sets = [gone for size in range(1, most + 1) for gone in combinations(links, size)]
        each = [dual_needs(Y, *without(at, at.W, at.G, gone)) for gone in sets]
    elif kind == "links":
        gone = [links[0], links[-1]]
        keys = {"scenarios": [{"drop": [list(link) for link in gone]}]}
        each = [dual_needs(Y, *without(at, at.W, at.G, gone))]
    else:
        scenario = {} if kind == "none" else {"weights": other["weights"], "gains": other["gains"]}
        if kind in ("weights", "gains"):
            scenario = {kind: other[kind]}
        keys = {"scenarios": [{}, scenario]}
        W = at.weights(other["weights"], at.read) if "weights" in scenario else at.W
        G = at.gains(other["gains"], at.read) if "gains" in scenario else at.G
        each = [dual_needs(Y, W, at.loops(G))]
    limit = 1 - max(max(needed) for needed in [nominal, *each])
    assert 0 < limit < 1
    assert result(data, switching(limit - CLOSE, Y, **keys)) == "valid"
    assert result(data, switching(limit + CLOSE, Y, **keys)) == "invalid"


@pytest.mark.parametrize("drop", [0, -1, 1.0, None])
def test_no_link_is_no_claim(drop: Any) -> None:
    data = maker.random_data(np.random.default_rng(0), 2, maker.ring(4), radius=0.15)
    assert result(data, switching(0.0, [np.eye(2)] * 4, drop=drop)) == "invalid"


@pytest.mark.parametrize("link", [[0, -1], [0, 4], [0, True], [0, 0], [1.0, 0], [0, 2], [0], "01", None])
def test_what_drops_is_a_link_between_nodes(link: Any) -> None:
    data = maker.random_data(np.random.default_rng(0), 2, maker.ring(4), radius=0.15)
    Y = [np.eye(2)] * 4
    assert result(data, switching(0.0, Y, scenarios=[{"drop": [[0, 1]]}])) == "valid"
    assert result(data, switching(0.0, Y, scenarios=[{"drop": [link]}])) == "invalid"
    assert result(data, switching(0.0, Y, scenarios=[{"drop": [[1, 2], link]}])) == "invalid"


def test_a_node_with_a_negative_weight_loses_no_link() -> None:
    data = maker.random_data(np.random.default_rng(0), 2, maker.ring(4), radius=0.05, negative=True)
    Y = [np.eye(2)] * 4
    assert result(data, switching(0.0, Y, scenarios=[{}])) == "valid"
    assert result(data, switching(0.0, Y, drop=1)) == "invalid"


# ---- Witnesses of instability ----


def refuted(method: str, **witness: Any) -> Document:
    said = maker.said_unstable()
    claim = {"claim": "schur-stability", "block": "network", "verdict": "refuted", "statement": said}
    return {**claim, "margin": None, "reason": None, "witness": {"of": "network", "method": method, **witness}}


def test_a_vector_of_zeros_refutes_nothing() -> None:
    """A stable network has F' X F - X > 0 as well, for a negative X."""
    for v, a, X, expected in ((0.0, 0.5, -1.0, "invalid"), (1.0, 0.5, -1.0, "invalid"), (0.0, 2.0, 1.0, "invalid")):
        assert result(scalar_data(a), refuted("lyapunov", X=text([X]), v=text([v]))) == expected
    assert result(scalar_data(2.0), refuted("lyapunov", X=text([1.0]), v=text([1.0]))) == "valid"


def plant(A: ndarray) -> Document:
    """One relay: F = A."""
    n = len(A)
    return {**scalar_data(1.0), "n": n, "A": text(A), "process": {"Q": text(np.eye(n))}}


# ---- Performance ----


def bounds(data: Document, rng: np.random.Generator, delta: float) -> tuple[Document, float, float]:
    """A random proof; the largest delta of the nodes, and the size that the centre's matrix needs."""
    at = Numbers(data)
    n, N = at.n, at.N
    F, noise, coupling = at.whole()
    exact = np.linalg.solve(np.eye(len(F) ** 2) - np.kron(F, F), noise.ravel()).reshape(F.shape)
    error = rng.normal(size=F.shape)
    Q = (exact + exact.T + 0.01 * (error + error.T)) / 2
    Y = [definite(rng, n) + 1.5 * np.eye(n) for _ in range(N + 1)]
    images = [at.M[l].T @ sum(at.sigma[k] * abs(at.W[l, k]) * Y[k] for k in range(N)) @ at.M[l] for l in range(N)]
    most = 1 - max(map(largest, images, Y[:N])) ** 0.5
    reached = np.sum([coupling[k].T @ Y[k] @ coupling[k] for k in range(N)], axis=0)
    least = largest(reached, delta * ((1 - delta) * Y[N] - at.Fe.T @ Y[N] @ at.Fe))
    proof = {"Q": triangle(Q), "Y": Y}
    return proof, most, least


def msd(proof: Document, Y: list[ndarray], delta: float, **intervals: list[float]) -> Document:
    nodes = len(Y) - 1
    wide = [-1e9, 1e9]
    low, high = intervals.get("network", wide)
    said = maker.said_performance(low, high)
    claim = {"claim": "performance", "verdict": "proved", "statement": said, "margin": None, "reason": None}
    own = {
        "nodes": [text(intervals.get("nodes", wide))] * nodes,
        "centre": text(intervals.get("centre", wide)),
        "network": text([low, high]),
    }
    return {**claim, **own, "proof": {**proof, "Y": [triangle(y) for y in Y], "delta": delta.hex()}}


def coupled(seed: int) -> Document:
    rng = np.random.default_rng(seed)
    return maker.random_data(rng, 2, maker.path(3), radius=0.1, tilt=0.3, relays=(2,) if seed == 1 else ())


@pytest.mark.parametrize("seed", range(4))
def test_the_contraction_of_the_nodes_that_performance_needs(seed: int) -> None:
    data = coupled(seed)
    proof, most, _ = bounds(data, np.random.default_rng(seed), 0.5)
    *nodes, _ = proof["Y"]
    assert 0 < most < 1
    room = (1 - most) ** 0.5 * (1 - 1e-3)
    last = solve_discrete_lyapunov(Numbers(data).Fe.T / room, np.eye(2))
    assert np.linalg.eigvalsh(last)[0] > 0
    for delta, holds in ((most * (1 - CLOSE), True), (most * (1 + CLOSE), False)):
        assert result(data, msd(proof, [*nodes, 1e9 * last], delta)) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("delta", [0.05, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_the_contraction_of_the_centre_that_performance_needs(seed: int, delta: float) -> None:
    data = coupled(seed)
    proof, most, least = bounds(data, np.random.default_rng(seed), delta)
    *nodes, last = proof["Y"]
    size = max(np.linalg.eigvalsh(y)[0] for y in proof["Y"])  # so that Y > I stays out of it
    nodes, last = [100 / size * y for y in nodes], 100 / size * last
    assert delta < most
    assert least > 0
    for scale, holds in ((least * (1 + CLOSE), True), (least * (1 - CLOSE), False)):
        above = 1 / min(1.0, np.linalg.eigvalsh(scale * last)[0] / 1.1)
        Y = [above * y for y in [*nodes, scale * last]]
        assert result(data, msd(proof, Y, delta)) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("k", range(4))
def test_the_size_that_performance_needs(k: int) -> None:
    """Y > I, of every node and of the centre: without it a trace is not below tr(Y E)."""
    data = coupled(0)
    data["gains"] = [text([0.0] * len(words.split())) for words in data["gains"]]
    data["A"] = text(np.zeros((2, 2)))
    data["centre"]["tilt"] = text(np.zeros((2, 1)))
    _, noise, _ = Numbers(data).whole()
    proof = {"Q": triangle(noise)}
    for least, holds in ((1 + CLOSE, True), (1 - CLOSE, False)):
        Y = [2 * np.eye(2) for _ in range(4)]
        Y[k] = np.diag([2.0, least])
        assert result(data, msd(proof, Y, 0.01)) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("part", ["nodes", "centre", "network"])
@pytest.mark.parametrize("seed", range(4))
def test_the_residual_that_performance_allows(seed: int, part: str) -> None:
    """One node, one state: sum_ij |Z_ij| y_i y_j for the roots y of Y, on both ends of each interval."""
    rng = np.random.default_rng(seed)
    data = maker.random_data(rng, 1, [[0]], radius=0.3, tilt=0.2)
    F, noise, coupling = Numbers(data).whole()
    Q = np.array([[4.0, 0.25], [0.25, 16.0 if seed % 2 else 1.0]])
    Z, delta = abs(F @ Q @ F.T + noise - Q), 0.05
    Y = np.array([2.0, max(5.0, 100 * coupling[0][0, 0] ** 2 / delta)])
    error = float(Y**0.5 @ Z @ Y**0.5) / delta
    middle = Q[1, 1] if part == "centre" else Q[0, 0]
    for close, holds in ((1 + CLOSE, True), (1 - CLOSE, False)):
        for a, b in ((close, 2.0), (2.0, close)):
            intervals = {part: [float(middle - a * error), float(middle + b * error)]}
            claim = msd({"Q": triangle(Q)}, [y * np.eye(1) for y in Y], delta, **intervals)
            assert result(data, claim) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("nodes", [1, 2, 3])
def test_the_roots_of_Y_are_not_rounded_down(nodes: int) -> None:
    """F = I / 2, Q = I, so that Z has 1/4 on its diagonal and 1 elsewhere; Y = 2 I, whose root is irrational."""
    data = {**scalar_data(0.5), "nodes": nodes, "neighbours": [[k] for k in range(nodes)]}
    data |= {"C": [""] * nodes, "noise": [{}] * nodes, "gains": [""] * nodes, "weights": [text([1.0])] * nodes}
    data["centre"] = {"gain": [""] * nodes, "tilt": text([0.0]), "columns": 1}
    blocks = nodes + 1
    total = 2 * (blocks / 4 + blocks * (blocks - 1)) / 0.25
    for part, error in (("nodes", total), ("centre", total), ("network", total / nodes)):
        for close, holds in ((1 + 2.0**-38, True), (1 - 2.0**-44, False)):
            interval = [1 - close * error, 1 + close * error]
            claim = msd({"Q": triangle(np.eye(blocks))}, [2 * np.eye(1)] * blocks, 0.25, **{part: interval})
            assert result(data, claim) == ("valid" if holds else "invalid")


def test_performance_needs_noise_on_every_sensor() -> None:
    """No gain uses any sensor, so that nothing else notices an R that is no covariance."""
    data = coupled(0)
    for gains in (data["gains"], data["centre"]["gain"]):
        gains[:] = [text([0.0] * len(words.split())) for words in gains]
    data["A"], data["centre"]["tilt"] = text(np.zeros((2, 2))), text(np.zeros((2, 1)))
    _, noise, _ = Numbers(data).whole()
    claim = msd({"Q": triangle(noise)}, [2 * np.eye(2)] * 4, 0.01)
    assert result(data, claim) == "valid"
    for k, given in enumerate(data["noise"]):
        for factor in (-1.0, 0.0):
            other = {"R": text([factor * float.fromhex(x) for x in given["R"].split()])}
            noises = [*data["noise"][:k], other, *data["noise"][k + 1 :]]
            assert result({**data, "noise": noises}, claim) == "invalid"


def test_performance_needs_a_process_noise_that_is_one() -> None:
    """F = 0: the solution is Q itself, whatever it is."""
    data = {**scalar_data(0.0), "centre": {"gain": [""], "tilt": "", "columns": 0}}
    for Q, holds in ((1.0, True), (0.0, True), (-1.0, False)):
        claim = msd({"Q": text([Q] * 3)}, [2 * np.eye(1)] * 2, 0.25)
        assert result({**data, "process": {"Q": text([Q])}}, claim) == ("valid" if holds else "invalid")
