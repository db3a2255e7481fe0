"""Just inside the truth is valid, at it and just outside is not: instances whose truth is known exactly."""

from __future__ import annotations

import math
import random
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from tests.certificates.examples import certificate
from tests.reference import certificates as maker
from tests.reference.certificate_truth import mean_square_deviations, radius_is_below, symmetric
from tests.reference.certificates import Document, Numbers, document, scalar_data, text, triangle

from tolnet.certificates.check import Matrix, check, is_positive_definite, is_semidefinite

TINY = 2.0**-50
STABLE, UNSTABLE = maker.said_stable("network"), maker.said_unstable()
NEAR = pytest.mark.parametrize(
    ("a", "stable"), [(1 - TINY, True), (1.0, False), (-1.0, False), (TINY - 1, True), (1 + TINY, False), (0.0, True)]
)


def times(factor: float, words: str) -> str:
    """The numbers of a text, each times a factor."""
    return text([factor * float.fromhex(word) for word in words.split()])


def result(data: Document, claim: Document) -> str:
    return check(document(data, claim))[0].result


def proved(method: str, margin: Any = 0.0, **proof: Any) -> Document:
    return {
        "claim": "schur-stability",
        "block": "network",
        "verdict": "proved",
        "statement": STABLE,
        "margin": margin,
        "reason": None,
        "proof": {"method": method, **proof},
    }


def refuted(method: str, **witness: Any) -> Document:
    return {
        "claim": "schur-stability",
        "block": "network",
        "verdict": "refuted",
        "statement": UNSTABLE,
        "margin": None,
        "reason": None,
        "witness": {"of": "network", "method": method, **witness},
    }


ONE, EVERY = (
    text([1.0]),
    {
        "primal": {"X": [text([1.0])]},
        "dual": {"Y": [text([1.0])]},
        "power": {"power": 2, "X": [text([1.0])], "shares": [text([1.0])]},
        "full": {"X": text([1.0])},
    },
)


@NEAR
@pytest.mark.parametrize("method", EVERY)
def test_one_state_near_the_circle(method: str, a: float, stable: bool) -> None:
    """F = a: no X proves |a| >= 1, and X = 1 proves every |a| < 1, however near."""
    assert result(scalar_data(a), proved(method, **EVERY[method])) == ("valid" if stable else "invalid")
    assert result(scalar_data(1.0, w=a), proved(method, **EVERY[method])) == "invalid"  # w = a is no diffusion
    for X in (0.0, -1.0):
        singular = {key: value if key in ("power", "shares") else text([X]) for key, value in EVERY[method].items()}
        singular = {key: [value] if isinstance(EVERY[method][key], list) and key != "shares" else value
                    for key, value in singular.items()}  # fmt: skip
        assert result(scalar_data(a), proved(method, **singular)) == "invalid"


def test_one_state_just_outside_is_refuted() -> None:
    for a, outside in ((1 + TINY, True), (1.0, False), (1 - TINY, False)):
        assert result(scalar_data(a), refuted("lyapunov", X=ONE, v=ONE)) == ("valid" if outside else "invalid")


@pytest.mark.parametrize("method", EVERY)
def test_the_margin_is_exact(method: str) -> None:
    """a = 1/2, X = 1: s = 1 - delta against 1/4 (1/16 for two steps)."""
    limit = 1 - 2.0**-4 if method == "power" else 0.75
    for margin, holds in ((limit - 2.0**-53, True), (limit, False), (limit + 2.0**-53, False), (0, True)):
        assert result(scalar_data(0.5), proved(method, margin, **EVERY[method])) == ("valid" if holds else "invalid")
    for margin in (-TINY, 1.0, 1, 1.5, True, None, "0.1"):
        assert result(scalar_data(0.0), proved(method, margin, **EVERY[method])) == "invalid"


@pytest.mark.parametrize("method", EVERY)
def test_the_rate_is_exact(method: str) -> None:
    for rate, holds in ((0.5 + TINY, True), (0.5, False), (0.5 - TINY, False), (-0.6, False), (0.0, False)):
        claim = proved(method, **EVERY[method])
        said = maker.said_stable("network", rate)
        claim |= {"claim": "decay-rate", "rate": rate.hex(), "statement": said}
        assert result(scalar_data(0.5), claim) == ("valid" if holds else "invalid")


@pytest.mark.parametrize(
    ("method", "a", "diagonal"),
    [
        ("primal", 0.5, (4, 1)),
        ("power", 0.5, (4, 1)),
        ("full", 0.5, (4, 1)),
        ("dual", 0.5, (1, 4)),
        ("lyapunov", 2, (1, 16)),
    ],
)
def test_what_is_transposed_is_noticed(method: str, a: float, diagonal: tuple[float, float]) -> None:
    """F = [[a, 1], [0, a]]: the diagonal matrix proves it from one side only."""
    data = {**scalar_data(1.0), "n": 2, "A": text([a, 1, 0, a]), "process": {"Q": text([1, 0, 0, 1])}}
    for (x, y), expected in ((diagonal, "valid"), (diagonal[::-1], "invalid")):
        X = text([x, 0, y])
        proofs = {"primal": {"X": [X]}, "dual": {"Y": [X]}, "full": {"X": X}}
        proofs["power"] = {"X": [X], "power": 2, "shares": [ONE]}
        if method == "lyapunov":
            assert result(data, refuted(method, X=X, v=text([1, 0]))) == expected
        else:
            assert result(data, proved(method, **proofs[method])) == expected


@pytest.mark.parametrize("j", [3, 4, 5])
def test_the_rate_of_many_steps_is_exact(j: int) -> None:
    for rate, holds in ((0.5 + TINY, True), (0.5, False)):
        claim = proved("power", **{**EVERY["power"], "power": j})
        said = maker.said_stable("network", rate)
        claim |= {"claim": "decay-rate", "rate": rate.hex(), "statement": said}
        assert result(scalar_data(0.5), claim) == ("valid" if holds else "invalid")


def test_the_shares_may_reach_one_but_not_exceed_it() -> None:
    """F = [[a/2, a/2], [a/2, a/2]], a = 1 - tiny: radius a."""
    data = {**scalar_data(1 - TINY), "nodes": 2, "C": [""] * 2, "noise": [{}] * 2, "gains": [""] * 2}
    data |= {"neighbours": [[0, 1]] * 2, "weights": [text([0.5, 0.5])] * 2}
    for shares, holds in (([0.5, 0.5], True), ([0.5, 0.5 + TINY], False), ([1.0, 0.5], False), ([0.5, 0.25], False)):
        proof = {"power": 2, "X": [ONE] * 2, "shares": [text(shares)] * 2}
        assert result(data, proved("power", **proof)) == ("valid" if holds else "invalid")
    for shares in ([1.0, 0.0], [1.5, -0.5], [1.0]):
        proof = {"power": 2, "X": [ONE] * 2, "shares": [text(shares)] * 2}
        assert result(data, proved("power", **proof)) == "invalid"


@pytest.mark.parametrize("slack", [TINY, 0.0, -TINY])
def test_signed_weights_count_by_their_size(slack: float) -> None:
    """w = (3/2, -1/2), M = a: the block conditions see sum |w| = 2, so a = 1/2 is the limit, whatever F is."""
    data = {**scalar_data(0.5 - slack), "nodes": 2, "C": [""] * 2, "noise": [{}] * 2, "gains": [""] * 2}
    data |= {"neighbours": [[0, 1]] * 2, "weights": [text([1.5, -0.5]), text([-0.5, 1.5])]}
    for method, key in (("primal", "X"), ("dual", "Y")):
        assert result(data, proved(method, **{key: [ONE] * 2})) == ("valid" if slack > 0 else "invalid")


@pytest.mark.parametrize("direct", [True, False])
def test_the_centre_counts_where_the_block_is_F(direct: bool) -> None:
    """F_0 = 1/4, N = 3/4: F_e = 1/4 + 3 y^2 / 16, which is 1 at y = 2; the network has nothing to do with it."""
    for y, stable in ((2 - TINY, True), (2.0, False), (2 + TINY, False)):
        data = {**scalar_data(0.25), "centre": {"gain": [""], "tilt": text([y]), "columns": 1}}
        data["process"] = {"Q": text([0.75])}
        proof = {"method": "primal", "X": [ONE], "centre": ONE}
        said = maker.said_stable("F")
        claim = proved("primal") | {"block": "F", "proof": proof, "statement": said}
        assert result(data, claim) == ("valid" if stable else "invalid")
        gone = {**data, "centre": None}
        assert result(gone, claim) == "invalid"
        witness = {"of": "centre", "method": "lyapunov", "X": ONE, "v": ONE}
        claim = refuted("lyapunov") | {
            "block": "F",
            "statement": maker.said_unstable("least favourable"),
            "witness": witness,
        }
        assert result(data, claim) == ("valid" if y > 2 else "invalid")
        assert result(data, claim | {"block": "network"}) == "invalid"


def switching_data(a: float, g: float, *, directed: bool = False) -> Document:
    """Two nodes with one state, which measure it: M_k = a - 2 g together, a - g alone."""
    return {
        **scalar_data(a),
        "nodes": 2,
        "C": [ONE] * 2,
        "noise": [{"R": ONE}] * 2,
        "directed": directed,
        "neighbours": [[0, 1], [0, 1]],
        "weights": [text([0.5, 0.5])] * 2,
        "gains": [text([g, g])] * 2,
    }


@pytest.mark.parametrize(("g", "holds"), [(0.5 + TINY, True), (0.5, False), (0.5 - TINY, False)])
@pytest.mark.parametrize("directed", [True, False])
def test_a_link_that_drops_takes_its_measurement_along(g: float, holds: bool, directed: bool) -> None:
    """a = 3/2: M alone is 3/2 - g, inside the circle if g > 1/2; together 3/2 - 2 g is near 1/2."""
    data = switching_data(1.5, g, directed=directed)
    Y = {"Y": [ONE] * 2}
    how = {} if directed else {"drop 1": {"drop": 1}}
    how |= {"every link": {"scenarios": [{"drop": [[0, 1], [1, 0]] if directed else [[0, 1]]}]}}
    for name, own in how.items():
        claim = {
            "claim": "switching",
            "verdict": "proved",
            "statement": maker.said_switching(own),
            "margin": 0,
            "reason": None,
            "proof": Y,
            **own,
        }
        assert result(data, claim) == ("valid" if holds else "invalid"), name
        negative = {**data, "weights": [text([1.5, -0.5])] * 2}
        assert result(negative, claim) == "invalid"


@pytest.mark.parametrize(
    ("scenario", "holds"),
    [
        ({}, True),
        ({"weights": [text([0.5, 0.25])] * 2}, False),
        ({"weights": [text([0.75, 0.25])] * 2}, True),
        ({"weights": [text([1.5, -0.5])] * 2}, False),
        ({"gains": [text([0.25 + TINY, 0.25])] * 2}, True),
        ({"gains": [text([0.25, 0.25])] * 2}, False),
        ({"gains": [text([0.0, 0.0]), text([0.5, 0.5])]}, False),
        ({"weights": [text([1.5, -0.5])] * 2, "gains": [text([0.625, 0.625])] * 2}, True),
    ],
)
def test_every_scenario_counts(scenario: Document, holds: bool) -> None:
    """M = 3/2 less both gains, Y = 1: stable together, whatever the order of the scenarios."""
    said = maker.said_switching({"scenarios": [{}, {}]})
    claim = {"claim": "switching", "verdict": "proved", "statement": said, "margin": 0, "reason": None}
    claim["proof"] = {"Y": [ONE] * 2}
    for scenarios in ([scenario, {}], [{}, scenario]):
        found = result(switching_data(1.5, 0.5), claim | {"scenarios": scenarios})
        assert found == ("valid" if holds else "invalid")


@pytest.mark.parametrize("own", [{"drop": 1}, {"scenarios": []}])
def test_an_indefinite_Y_proves_no_switching(own: Document) -> None:
    """F = 2, Y = -1: Y - F' Y F = 3 is positive all the same."""
    said = maker.said_switching(own)
    claim = {"claim": "switching", "verdict": "proved", "statement": said, "margin": 0, "reason": None, **own}
    for a, Y, holds in ((2.0, -1.0, False), (2.0, 1.0, False), (0.5, 1.0, True), (0.5, 0.0, False)):
        claim["proof"] = {"Y": [text([Y])]}
        assert result(scalar_data(a), claim) == ("valid" if holds else "invalid")


@pytest.mark.parametrize("seed", range(12))
def test_intervals_are_as_narrow_as_the_proof_allows_and_no_narrower(seed: int) -> None:
    """The exact mean square deviation lies in every valid interval; half of the proven error is refused."""
    rng = np.random.default_rng(seed)
    data = maker.random_data(rng, 1 + seed % 2, maker.ring(3), radius=1.0, columns=seed % 3)
    claim = maker.performance_claim(data)
    assert result(data, claim) == "valid"
    traces = mean_square_deviations(Numbers(data, Fraction))
    for words, trace in zip([*claim["nodes"], claim["centre"]], traces, strict=True):
        low, high = map(float.fromhex, words.split())
        assert Fraction(low) < trace < Fraction(high)
    proof = claim["proof"]
    n = data["n"]
    size = (data["nodes"] + 1) * n
    Q = symmetric(proof["Q"], size)
    F, noise, _ = Numbers(data, Fraction).whole()
    Z = abs(F @ Q @ F.T + noise - Q)
    y = [math.sqrt(x) for words in proof["Y"] for x in np.diagonal(symmetric(words, n))]
    error = sum(Z[i, j] * Fraction(y[i] * y[j]) for i in range(size) for j in range(size))
    error /= Fraction(float.fromhex(proof["delta"]))
    middle = sum(Q[i, i] for i in range(n))
    most, least = error * (1 + Fraction(1, 10**9)), error
    wide = [math.nextafter(float(middle - most), -math.inf), math.nextafter(float(middle + most), math.inf)]
    assert result(data, claim | {"nodes": [text(wide), *claim["nodes"][1:]]}) == "valid"
    for narrow in (
        [wide[0], float(middle + least * Fraction(9, 10))],
        [float(middle - least * Fraction(9, 10)), wide[1]],
        [wide[1], wide[0]],
    ):
        assert result(data, claim | {"nodes": [text(narrow), *claim["nodes"][1:]]}) == "invalid"
        assert result(data, claim | {"nodes": [*claim["nodes"][:-1], text(narrow)]}) == "invalid"


def test_a_scenario_says_one_thing() -> None:
    """Links that drop, or other weights and gains: both together would leave one of them unproved."""
    said = maker.said_switching({"scenarios": [{}]})
    claim = {"claim": "switching", "verdict": "proved", "statement": said, "margin": 0, "reason": None}
    claim["proof"] = {"Y": [ONE] * 2}
    data, wild = switching_data(1.125, 0.5), [text([6.5, -5.5])] * 2
    for scenario, holds in (({"drop": [[0, 1]]}, True), ({"weights": wild}, False), ({}, True)):
        assert result(data, claim | {"scenarios": [scenario]}) == ("valid" if holds else "invalid")
    for other in ({"weights": wild}, {"gains": wild}):
        assert result(data, claim | {"scenarios": [{"drop": [[0, 1]], **other}]}) == "invalid"


@pytest.mark.parametrize(
    ("rows", "semidefinite"),
    [
        ([[0]], True),
        ([[-1]], False),
        ([[1, 1], [1, 1]], True),
        ([[1, 2], [2, 1]], False),
        ([[1, -1], [-1, 1]], True),
        ([[0, 1], [1, 0]], False),
        ([[0, 0], [0, 1]], True),
        ([[0, 0, 1], [0, 1, 0], [1, 0, 1]], False),
        ([[2, 1, 1], [1, 1, 0], [1, 0, 1]], True),
        ([[2, 1, 1], [1, 1, 0], [1, 0, 0]], False),
        ([[4, 2, 6], [2, 1, 3], [6, 3, 9]], True),
        ([[4, 2, 6], [2, 1, 3], [6, 3, 8]], False),
        ([[3, 1, 1], [1, 1, 0], [1, 0, 1]], True),
        ([[1, 1, 0], [1, 1, 1], [0, 1, 9]], False),
        ([[10**40, 10**40], [10**40, 10**40]], True),
        ([[10**40, 10**40 + 1], [10**40 + 1, 10**40]], False),
    ],
)
def test_semidefiniteness_is_decided_exactly(rows: list[list[int]], semidefinite: bool) -> None:
    assert is_semidefinite(Matrix(rows)) is semidefinite
    assert is_semidefinite(Matrix([row[::-1] for row in rows[::-1]])) is semidefinite


def test_a_wrong_solution_does_not_reach_its_intervals() -> None:
    """Q off by one part in 2^20: the residual says so."""
    found = certificate("performance")
    proof = found["claims"][0]["proof"]
    for factor in (1 + 2.0**-20, 1 - 2.0**-20):
        proof["Q"] = " ".join((factor * float.fromhex(x)).hex() for x in proof["Q"].split())
        assert check(found)[0].result == "invalid"


def exact(S: np.ndarray) -> Matrix:
    """A matrix of dyadic fractions, as the checker holds it."""
    scale = max(x.denominator for x in S.ravel())
    return Matrix([[int(x * scale) for x in row] for row in S.tolist()], 1 - scale.bit_length())


@pytest.mark.parametrize("size", [1, 2, 5, 12, 13, 14, 30])
@pytest.mark.parametrize("condition", [1.0, 1e6, 1e14, 1e24])
def test_definiteness_is_decided_at_the_last_bit(size: int, condition: float) -> None:
    """S = L L' - s v v' with v' (L L')^-1 v = 1: definite for s below 1, singular there, indefinite above."""
    rng = random.Random(size)
    L = np.full((size, size), Fraction(0), dtype=object)
    for i in range(size):
        L[i, i] = Fraction(2 ** round(i / max(1, size - 1) * np.log2(condition) / 2))
        for j in range(i):
            L[i, j] = Fraction(rng.randint(-8, 8), 8)
    u = np.array([Fraction(0)] * (size - 1) + [Fraction(1)], dtype=object)
    v = L @ u  # v' (L L')^-1 v = u'u = 1
    scales = [Fraction(2) ** rng.randint(-60, 60) for _ in range(size)]  # badly scaled rows
    S, V = np.array(L @ L.T), np.outer(v, v)
    bit = Fraction(1, 2**40)
    for s, definite in ((0, True), (1 - bit, True), (1, False), (1 + bit, False), (2, False)):
        T = S - s * V
        T = np.array([[T[i, j] * scales[i] * scales[j] for j in range(size)] for i in range(size)], dtype=object)
        assert is_positive_definite(exact(T)) is definite, s
        order = list(range(size - 1, -1, -1))
        assert is_positive_definite(exact(T[np.ix_(order, order)])) is definite, s


def test_zero_and_negative_matrices_are_not_definite() -> None:
    for size in (1, 3, 13, 20):
        unit = Matrix([[int(i == j) for j in range(size)] for i in range(size)])
        assert not is_positive_definite(0 * unit)
        assert is_positive_definite(unit)
        assert not is_positive_definite(-1 * unit)
        ones = Matrix([[1] * size for _ in range(size)], 0)
        assert is_positive_definite(ones) is (size == 1)
        for diagonal, definite in ((3, True), (2, False), (1, False)):
            rows = [[diagonal * (i == j) + 2 * (i + j == size - 1) for j in range(size)] for i in range(size)]
            assert is_positive_definite(Matrix(rows, 0)) is (definite or size == 1)


@pytest.mark.parametrize("seed", range(40))
def test_random_networks_on_both_sides(seed: int) -> None:
    """Plant and gains scaled until F is just stable or just unstable: proofs hold on their side only."""
    rng = np.random.default_rng(seed)
    neighbours = [maker.ring(3), maker.path(3), maker.one_way(3), [[0]]][seed % 4]
    relays = (0,) if seed % 5 == 0 else ()
    data = maker.random_data(rng, 1 + seed % 3, neighbours, directed=seed % 4 == 2, relays=relays)
    radius = max(abs(np.linalg.eigvals(Numbers(data).network)))
    for target in (1 - 1e-4, 1 + 1e-4):
        scaled = dict(data)
        scaled["A"] = times(target / radius, data["A"])
        scaled["gains"] = [times(target / radius, row) for row in data["gains"]]
        assert radius_is_below(Numbers(scaled, Fraction).network, Fraction(1)) == (-1 if target < 1 else 1)
        full = maker.stability_claim(scaled, "full", share_of_slack=0)
        assert result(scaled, full) == ("valid" if target < 1 else "invalid")
        found = result(scaled, maker.instability_claim(scaled, "lyapunov"))
        assert found == ("valid" if target > 1 else "invalid")
        identity = triangle(np.eye(data["n"]))
        for method, key in (("primal", "X"), ("dual", "Y")):
            claim = proved(method, **{key: [identity] * data["nodes"]})
            assert target < 1 or result(scaled, claim) == "invalid"
