"""Every condition of check.py turns from true to false where the formulas of docs/certificate.md do.

Nothing here is a solution of anything: the matrices of the proofs are drawn at random, the number at which the
condition starts to hold is computed from the formula, and the checker is asked on both sides of it.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
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
    said = f"Every eigenvalue of {BLOCKS[block]} lies inside the circle of radius {rate!r}."
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
    said = f"links drop and return, at most {keys['drop']} at once" if "drop" in keys else ""
    if "scenarios" in keys:
        said = f"the nominal network and {len(keys['scenarios'])} scenarios alternate"
    claim = {"claim": "switching", "verdict": "proved", "margin": margin, "reason": None, **keys}
    statement = f"The network block of the error dynamics stays stable however {said}."
    return {**claim, "statement": statement, "proof": {"Y": [triangle(y) for y in Y]}}


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
    said = "Some eigenvalue of the network block of the error dynamics lies outside the unit circle: errors grow."
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


class Exactly:
    """A complex matrix of fractions."""

    def __init__(self, z: ndarray) -> None:
        self.re, self.im = (np.array([Fraction(x) for x in part.ravel()], dtype=object).reshape(part.shape)
                            for part in (np.real(z).astype(float), np.imag(z).astype(float)))  # fmt: skip

    def norm(self) -> Fraction:
        return max((abs(self.re) + abs(self.im)).sum(axis=1))

    def times(self, other: Exactly) -> Exactly:
        found = Exactly(np.zeros((1, 1)))
        found.re = self.re @ other.re - self.im @ other.im
        found.im = self.re @ other.im + self.im @ other.re
        return found


def newton(A: ndarray, value: complex, z: ndarray, pivot: int, B: ndarray) -> tuple[Fraction, Fraction, Fraction]:
    """|B f|, |I - B J| and |B|, exactly."""
    d = len(A)
    J, f = Exactly(np.zeros((d + 1, d + 1))), Exactly(np.zeros((d + 1, 1)))
    a, b, exact = Fraction(value.real), Fraction(value.imag), Exactly(A)
    J.re[:d, :d], J.im[:d, :d] = exact.re - a * np.eye(d, dtype=int), -b * np.eye(d, dtype=int)
    x, y = Exactly(z[:, None]).re, Exactly(z[:, None]).im
    J.re[:d, d:], J.im[:d, d:] = -x, -y
    J.re[d, pivot] += 1
    f.re[:d], f.im[:d] = exact.re @ x - a * x + b * y, exact.re @ y - a * y - b * x
    inverse, defect = Exactly(B), Exactly(B).times(J)
    defect.re = np.eye(d + 1, dtype=int) - defect.re
    return inverse.times(f).norm(), defect.norm(), inverse.norm()


def coarsely(z: ndarray, bits: int) -> ndarray:
    scale = 2.0**bits
    return (np.round(np.real(z) * scale) + 1j * np.round(np.imag(z) * scale)) / scale


def parts(z: ndarray) -> str:
    return text([np.real(z), np.imag(z)])


@pytest.mark.parametrize("seed", range(12))
def test_the_radii_between_which_newtons_step_stays_inside(seed: int) -> None:
    """Coarse numbers, so that every term counts; the smallest and the largest radius that hold."""
    rng = np.random.default_rng(seed)
    n = 1 + seed % 3
    A = np.real(coarsely(4 * rng.normal(size=(n, n)) + 6 * np.eye(n), 4))
    values, vectors = np.linalg.eig(A)
    i = int(np.argmax(abs(values)))
    z = vectors[:, i] / vectors[np.argmax(abs(vectors[:, i])), i]
    value, z, pivot = complex(coarsely(values[i : i + 1], 7)[0]), coarsely(z, 7), int(np.argmax(abs(z)))
    J = np.block([[A - value * np.eye(n), -z[:, None]], [np.eye(n)[pivot], np.zeros((1, 1))]])
    B = coarsely(np.linalg.inv(J), 5)
    residual, defect, norm = newton(A, value, z, pivot, B)
    slack = float(1 - defect)
    spread = (slack**2 - 4 * float(norm * residual)) ** 0.5
    low, high = (slack - spread) / (2 * float(norm)), (slack + spread) / (2 * float(norm))
    assert 0 <= low < high
    assert abs(value) - high > 1.01
    tried = {low * (1 - CLOSE): False, low * (1 + CLOSE): True, high * (1 - CLOSE): True, high * (1 + CLOSE): False}
    for radius, inside in tried.items():
        rho = Fraction(radius)
        assert (residual + defect * rho + norm * rho**2 < rho) is (inside and radius > 0)
        witness = {
            "eigenvalue": text([value.real, value.imag]),
            "vector": parts(z),
            "pivot": pivot,
            "inverse": parts(B),
            "radius": text([radius]),
        }
        expected = "valid" if inside and radius > 0 else "invalid"
        assert result(plant(A), refuted("eigenpair", **witness)) == expected
        for wrong in (n, -1):  # the normalisation is of one of the entries of the vector
            assert result(plant(A), refuted("eigenpair", **{**witness, "pivot": wrong})) == "invalid"


def test_the_ball_of_an_eigenvalue_stays_outside_the_disc() -> None:
    """Eigenvalues 3/4 +- i of modulus 5/4, the pair exact: the radius may be up to 1/4, and 1/4 not."""
    A = np.array([[0.75, 1.0], [-1.0, 0.75]])
    z, value = np.array([1.0, 1.0j]), 0.75 + 1.0j
    J = np.block([[A - value * np.eye(2), -z[:, None]], [np.eye(2)[0], np.zeros((1, 1))]])
    B = np.linalg.inv(J)
    residual, defect, norm = newton(A, value, z, 0, B)
    assert residual == 0
    for radius, outside in ((0.25 - 2.0**-20, True), (0.25, False), (0.25 + 2.0**-20, False)):
        assert defect * Fraction(radius) + norm * Fraction(radius) ** 2 < Fraction(radius)
        witness = {"eigenvalue": text([0.75, 1.0]), "vector": parts(z), "pivot": 0}
        claim = refuted("eigenpair", **witness, inverse=parts(B), radius=text([radius]))
        assert result(plant(A), claim) == ("valid" if outside else "invalid")


# ---- Performance ----


def bounds(data: Document, rng: np.random.Generator) -> tuple[Document, float, Callable[[float], float]]:
    """A random proof; the least epsilon, and the largest delta for a share."""
    at = Numbers(data)
    n, N = at.n, at.N
    F, noise, coupling = at.whole()
    exact = np.linalg.solve(np.eye(len(F) ** 2) - np.kron(F, F), noise.ravel()).reshape(F.shape)
    error = rng.normal(size=F.shape)
    Q = exact + exact.T + 0.01 * (error + error.T)
    Q = Q / 2
    X = [definite(rng, n) + 3 * np.eye(n) for _ in range(N + 1)]
    Z = F @ Q @ F.T + noise - Q
    t = np.diag(Q) ** -0.5  # to within a factor of two, as powers of two
    sums = (abs(Z) * t[None, :]).sum(axis=1) / t
    needed = [largest(np.diag(sums[k * n : (k + 1) * n]), X[k]) for k in range(N + 1)]

    def most(share: float) -> float:
        found = [1 - largest(at.Fe @ X[N] @ at.Fe.T, X[N])]
        for k in range(N):
            own = at.sigma[k] * sum(abs(at.W[l, k]) * at.M[l] @ X[l] @ at.M[l].T for l in range(N))
            image = own / (1 - share) + coupling[k] @ X[N] @ coupling[k].T / share
            found.append(1 - largest(image, X[k]))
        return min(found)

    proof = {"method": "blocks", "Q": triangle(Q), "X": [triangle(x) for x in X]}
    return proof, max(needed), most


def msd(proof: Document, epsilon: float, delta: float, share: float, nodes: int) -> Document:
    wide = text([-1e9, 1e9])
    said = (
        "Under the stated least favourable model the mean square deviation of the network lies in "
        f"[{-1e9!r}, {1e9!r}], and that of every node in its interval."
    )
    claim = {"claim": "performance", "verdict": "proved", "statement": said, "margin": None, "reason": None}
    own = {"nodes": [wide] * nodes, "centre": wide, "network": wide}
    numbers = {"epsilon": epsilon.hex(), "delta": delta.hex(), "share": share.hex()}
    return {**claim, **own, "proof": {**proof, **numbers}}


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
@pytest.mark.parametrize("seed", range(4))
def test_the_contraction_that_performance_needs(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    data = maker.random_data(rng, 2, maker.path(3), radius=0.1, tilt=0.3, relays=(2,) if seed == 1 else ())
    proof, epsilon, most = bounds(data, rng)
    delta = most(share)
    assert 0 < delta < 1
    for e, d, holds in (
        (8 * epsilon, delta * (1 - CLOSE), True),
        (8 * epsilon, delta * (1 + CLOSE), False),
        (epsilon / 8, delta / 2, False),
    ):
        assert result(data, msd(proof, e, d, share, 3)) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("seed", range(4))
def test_the_residual_that_performance_allows(seed: int) -> None:
    """One node, one state: |Z_00| + |Z_01| t_1 / t_0 against epsilon X, with Q_ii powers of four."""
    rng = np.random.default_rng(seed)
    data = maker.random_data(rng, 1, [[0]], radius=0.3, tilt=0.2)
    F, noise, _ = Numbers(data).whole()
    Q = np.array([[4.0, 0.25], [0.25, 16.0 if seed % 2 else 1.0]])
    Z = abs(F @ Q @ F.T + noise - Q)
    t = np.diag(Q) ** -0.5
    needed = max((Z[0, 0] + Z[0, 1] * t[1] / t[0]) / 2, (Z[1, 1] + Z[1, 0] * t[0] / t[1]) / 5)
    proof = {"method": "blocks", "Q": triangle(Q), "X": [text([2.0]), text([5.0])]}
    assert result(data, msd(proof, needed * (1 + CLOSE), 0.05, 0.5, 1)) == "valid"
    assert result(data, msd(proof, needed * (1 - CLOSE), 0.05, 0.5, 1)) == "invalid"
