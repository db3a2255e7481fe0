"""Claims about filters, checked in the standard library alone: enclosures hold what is exact, and verdicts agree."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.certificates.alterations import designed, get, put
from tests.certificates.deployments import deployment_of, document
from tests.certificates.malformed import spoilt
from tests.instances_random import random_network
from tests.reference import exact as fine
from tests.reference.certificates import Document, text
from tests.study import sized

from tolnet import analysis, design
from tolnet.certificates import check as checker
from tolnet.certificates import check_arithmetic as arithmetic
from tolnet.certificates import check_filters as filters
from tolnet.certificates import convergence
from tolnet.certificates.check import Finding, Matrix, Refused, Wrong, check
from tolnet.certificates.check_arithmetic import Balls, Interval
from tolnet.certificates.filter_claims import FILTER_CLAIMS, SteadyStates, decide, find_centre
from tolnet.certificates.stated import stated_deployment
from tolnet.certificates.verify import verify_claims
from tolnet.model import Ambiguity, SensorNetwork

mp: Any = fine.mp
SPOILT = sized(40, 300)
"""Malformed files of each kind of claim."""
ALL = {**checker.RULES, **filters.RULES}


# -------------------- Enclosures ------------------------------------------------------------------------------


def an_interval(rng: random.Random, *, positive: bool = False) -> tuple[Interval, Fraction]:
    """An interval, and a number in it."""
    size = Fraction(2) ** rng.randint(-60, 60)
    low = rng.randint(1 if positive else -(10**6), 10**6) * size
    high = low + rng.choice((0, 1, 10**4)) * size
    return Interval(low, high), low + (high - low) * Fraction(rng.randint(0, 64), 64)


def holds(x: Interval, exact: Fraction) -> bool:
    return x.low <= exact <= x.high


@pytest.mark.parametrize("bits", [20, 64, 256])
def test_intervals_hold_sums_products_quotients_and_roots(bits: int) -> None:
    rng = random.Random(bits)
    with arithmetic.precision(bits):
        for _ in range(300):
            (X, x), (Y, y) = an_interval(rng), an_interval(rng)
            assert holds(X + Y, x + y)
            assert holds(X - Y, x - y)
            assert holds(X * Y, x * y)
            assert X.size >= abs(x)
            Z, z = an_interval(rng, positive=True)
            assert holds(X / Z, x / z)
            assert holds(X / -Z, -x / z)
            root = Z.sqrt()
            assert root.low > 0
            assert root.low**2 <= z <= root.high**2
            exact = arithmetic.exactly(z.numerator).sqrt()
            assert exact.low**2 <= z.numerator <= exact.high**2
            assert exact.high - exact.low <= exact.high * Fraction(4, 2**bits)


@pytest.mark.parametrize("bits", [20, 64, 256, 1000])
def test_logarithms_hold_those_of_other_arithmetic_and_are_narrow(bits: int) -> None:
    """Of numbers near one, tiny and huge; mpmath has 40 digits more."""
    rng = random.Random(bits)
    with arithmetic.precision(bits), mp.workprec(bits + 200):
        for _ in range(60):
            x = Fraction(rng.randint(1, 2**40), rng.choice((2**40, 2**20, 1))) * Fraction(2) ** rng.choice(
                (0, -900, 900)
            )
            x = rng.choice((x, 1 + Fraction(rng.randint(-99, 99), 2 ** rng.randint(8, 80))))
            found, exact = arithmetic.logarithm(x), mp.log(mp.mpf(x.numerator) / x.denominator)
            low, high = (mp.mpf(end.numerator) / end.denominator for end in (found.low, found.high))
            assert low <= exact <= high
            assert high - low <= (abs(exact) + 1) * mp.mpf(2) ** (4 - bits)
        assert arithmetic.exactly(1).log().low <= 0 <= arithmetic.exactly(1).log().high
        for bad in (Interval(Fraction(0), Fraction(1)), Interval(Fraction(-1), Fraction(1))):
            with pytest.raises(Wrong):
                bad.log()
            with pytest.raises(Wrong):
                _ = arithmetic.exactly(1) / bad


def some_balls(
    rng: random.Random, n: int, spread: int, *, symmetric: bool = False
) -> tuple[Balls, list[list[Fraction]]]:
    """A matrix with radii, in units 2^+-20 apart, and one of the matrices in it."""
    units = [Fraction(2) ** rng.randint(-20, 20) for _ in range(n)]
    middle, radius = ([[0] * n for _ in range(n)] for _ in range(2))
    member = [[Fraction(0)] * n for _ in range(n)]
    for i in range(n):
        for j in range(n):
            if symmetric and j < i:
                middle[i][j], radius[i][j], member[i][j] = middle[j][i], radius[j][i], member[j][i]
                continue
            unit = int(units[i] * units[j] * 2**40)
            middle[i][j] = (rng.randint(-100, 100) + 300 * n * (i == j)) * unit * 2**60
            radius[i][j] = rng.randint(0, spread) * unit
            member[i][j] = Fraction(middle[i][j] + radius[i][j] * Fraction(rng.randint(-32, 32), 32)) / 2**100
    return Balls(Matrix(middle, -100), Matrix(radius, -100)), member


def hold(M: Balls, exact: list[list[Fraction]]) -> bool:
    return all(holds(M.entry(i, j), x) for i, row in enumerate(exact) for j, x in enumerate(row))


def product(A: list[list[Fraction]], B: list[list[Fraction]]) -> list[list[Fraction]]:
    return [
        [sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*B, strict=True)]
        for row in A
    ]


@pytest.mark.parametrize("spread", [0, 1000, 10**14, 10**18])
def test_balls_hold_sums_products_and_inverses_of_their_members(spread: int) -> None:
    rng = random.Random(spread)
    for n in (1, 2, 3, 5):
        (P, p), (Q, q) = some_balls(rng, n, spread), some_balls(rng, n, spread)
        S, s = some_balls(rng, n, spread, symmetric=True)
        assert hold(P + Q, [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(p, q, strict=True)])
        assert hold(P - Q, [[x - y for x, y in zip(*rows, strict=True)] for rows in zip(p, q, strict=True)])
        assert hold(P @ Q, product(p, q))
        assert hold(arithmetic.congruence(P, S), product(product(p, s), [list(x) for x in zip(*p, strict=True)]))
        X, x = an_interval(rng)
        assert hold(P.times(X), [[x * y for y in row] for row in p])
        assert holds(P.trace(), sum((p[i][i] for i in range(n)), Fraction(0)))
        identity = [[Fraction(i == j) for j in range(n)] for i in range(n)]
        back = arithmetic.inverse(P)
        residual = back @ arithmetic.exact(matrix_of(p)) - arithmetic.unit(n)
        assert hold(residual, [[Fraction(0)] * n] * n)  # X P = I for the one X that is meant
        assert hold(back, solved(p, identity))
        with arithmetic.precision(256):
            det = arithmetic.determinant(matrix_of(p))
            log = arithmetic.log_det(P, back)
            exact = arithmetic.logarithm(abs(det))
        assert det > 0
        assert log.low <= exact.high
        assert exact.low <= log.high
        image = product(product(p, s), [list(x) for x in zip(*p, strict=True)])
        pairs = arithmetic.upper(n)
        moved = arithmetic.squared(P) @ arithmetic.coordinates(arithmetic.exact(matrix_of(s)))
        assert hold(moved, [[image[i][j]] for i, j in pairs])


def matrix_of(rows: list[list[Fraction]]) -> Matrix:
    """Dyadic numbers, exactly."""
    scale = max(x.denominator for row in rows for x in row)
    return Matrix([[int(x * scale) for x in row] for row in rows], 1 - scale.bit_length())


def solved(A: list[list[Fraction]], B: list[list[Fraction]]) -> list[list[Fraction]]:
    """A^-1 B by elimination in fractions."""
    rows = [[*a, *b] for a, b in zip(A, B, strict=True)]
    for k in range(len(rows)):
        best = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[best] = rows[best], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        rows = [
            row if i == k else [x - row[k] * y for x, y in zip(row, rows[k], strict=True)]
            for i, row in enumerate(rows)
        ]
    return [row[len(rows) :] for row in rows]


def test_definite_is_what_is_shown_of_every_member() -> None:
    """[[1 +- r, 1], [1, 2 +- r]] is definite for r below (3 - sqrt 5) / 2 = 0.38197; then has a singular member."""
    for r, verdict in ((0, True), (1 / 4, True), (0.375, True), (0.3825, False), (1, False)):
        radius = Matrix([[int(r * 2**20), 0], [0, int(r * 2**20)]], -20)
        assert arithmetic.is_positive(Balls(Matrix([[1, 1], [1, 2]]), radius)) is verdict
    rng = random.Random(5)
    for n in (2, 4):
        for spread in (0, 10**18, 10**20, 10**21):
            S, s = some_balls(rng, n, spread, symmetric=True)
            if arithmetic.is_positive(S):
                assert checker.is_positive_definite(matrix_of(s))
                assert arithmetic.determinant(matrix_of(s)) > 0
    assert not arithmetic.is_positive(arithmetic.exact(Matrix([[1, 2], [2, 1]])))
    assert arithmetic.outweighs(
        Balls(Matrix([[100, 60], [1, 2]]), Matrix([[0, 0], [0, 0]]))
    )  # rows alone do not say so
    assert not arithmetic.outweighs(Balls(Matrix([[1, 1], [1, 1]]), Matrix([[0, 0], [0, 0]])))


@pytest.mark.parametrize("c", [1e-14, 1e-3, 1.0, 1e6])
def test_theta_is_enclosed(c: float) -> None:
    """gamma(P, theta) = c of a covariance in units 10^8 apart, against mpmath with 60 digits."""
    P = np.array([[4.0, 1e-4, 0.5], [1e-4, 3e-8, 1e-5], [0.5, 1e-5, 2.0]])
    one = arithmetic.exact(checker.unit(3))
    equations = filters.Equations(one, one, one, one, Fraction(c))
    found = filters.enclose_theta(
        equations, arithmetic.exact(matrix_of([[Fraction(x) for x in row] for row in P.tolist()]))
    )
    with mp.workdps(60):
        values = [mp.mpf(1) * x for x in mp.eigsy(mp.matrix(P.tolist()), eigvals_only=True)]
        for end, sign in ((found.low, -1), (found.high, 1)):
            theta = mp.mpf(end.numerator) / end.denominator
            gamma = sum(mp.log(1 - theta * x) + 1 / (1 - theta * x) - 1 for x in values)
            assert sign * (gamma - mp.mpf(c)) >= -mp.mpf(c) * mp.mpf(10) ** -35
        assert found.high - found.low <= found.high * Fraction(1, 10**35)


# -------------------- Certificates ----------------------------------------------------------------------------


def network(c: float, a: float = 0.9) -> SensorNetwork:
    """Three nodes of a plant of two states, one of them a relay; 1,000 between the units of the states."""
    units = np.diag([1.0, 1e3])
    A = units @ np.array([[a, 0.2], [-0.1, 0.8]]) @ np.linalg.inv(units)
    C = [np.array([[1.0, 0.0]]), np.array([[0.3, 1e-3], [1.0, 0.0]]), np.empty((0, 2))]
    R = [np.array([[0.5]]), np.array([[1.0, 0.1], [0.1, 0.6]]), np.empty((0, 0))]
    return SensorNetwork(A=A, B=units, C=C, R=R, edges=[[0, 1], [1, 2]], name="small", ambiguity=Ambiguity(c))


@cache
def certificate(c: float) -> Document:
    """Every claim about every filter of the network that is decided."""
    problem = network(c)
    table = design.choose_tolerances(problem)
    deployed, central, local = deployment_of(problem), table.central, table.local
    centre = find_centre(deployed, c, central.P, float(central.theta))
    nodes = ["centre", *range(problem.N)]
    P, theta = [central.P, *local.P], [float(central.theta), *map(float, local.theta)]
    states = SteadyStates(nodes, [c, *map(float, local.tolerance)], P, theta, centre)
    return document(deployed, *(v for v in decide(states, deployed, FILTER_CLAIMS) if v.verdict != "undecided"))


def findings(found: Document) -> list[Finding]:
    return check(found, rules=ALL)


def of_node_1(found: Document) -> dict[str, int]:
    """Where each claim about node 1 stands."""
    return {claim["claim"]: i for i, claim in enumerate(found["claims"]) if claim["node"] == 1}


def alone(found: Document, i: int) -> Document:
    """With one claim only."""
    return {**found, "claims": [found["claims"][i]]}


@pytest.mark.parametrize("c", [0.0, 1e-9, 1e-3])
def test_what_is_proved_of_filters_is_valid(c: float) -> None:
    found = certificate(c)
    assert {claim["claim"] for claim in found["claims"]} == set(FILTER_CLAIMS)
    assert {(f.result, f.reason) for f in findings(found)} == {("valid", None)}
    assert {f.result for f in check(found)} == {"not checked here"}


def test_it_runs_as_plain_files_beside_each_other(tmp_path: Path) -> None:
    for module in (checker, arithmetic, filters):
        shutil.copy(str(module.__file__), tmp_path)
    (tmp_path / "certificate.json").write_text(json.dumps(certificate(1e-3)))

    def run(name: str, *options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-I", "-S", str(tmp_path / name), str(tmp_path / "certificate.json"), *options]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    done = run("check_filters.py")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\nvalid: ") + 1 == len(certificate(1e-3)["claims"])
    some = json.loads(run("check_filters.py", "--claims", "tolerance,attraction", "--json").stdout)
    assert {finding["claim"] for finding in some["findings"]} == {"tolerance", "attraction"}
    assert some["summary"]["valid, proved"] == len(some["findings"]) == 7
    assert run("check.py", "--claims", "nonsense").returncode == 2
    done = run("check.py")
    assert done.returncode == 3
    assert "need tolnet check: it needs a logarithm" in done.stdout


def said_in_balls(found: Document) -> list[bool]:
    """What `tolnet check` says of the claims."""
    try:
        deployed = stated_deployment(found["data"])
    except ValueError:
        return [False] * len(found["claims"])
    return [answer is None for answer in verify_claims(found["claims"], deployed)]


@pytest.mark.parametrize("name", FILTER_CLAIMS)
def test_nothing_altered_is_valid_that_balls_refuse(name: str) -> None:
    """Every designed alteration of a claim; what stays valid is valid in python-flint too."""
    original = certificate(1e-3)
    i = of_node_1(original)[name]
    refused = 0
    every = [(what, altered) for what, altered in designed(alone(original, i)) if altered != original]
    of_data = [
        what for what, _ in every if "('data'" in what or what.startswith(("node ", "n ", "nodes ", "directed "))
    ]
    left_out = set(of_data) - set(of_data[:: sized(24, 4)])  # most make no network at all, or another one
    for what, altered in every:
        if what in left_out:
            continue
        try:
            results = [finding.result for finding in findings(altered)]
        except Refused:
            refused += 1
            continue
        refused += results != ["valid"]
        if results == ["valid"]:
            assert said_in_balls(altered) == [True], what
    assert refused >= 50


def changed(claim: Document, key: str, x: float) -> Document:
    return {**claim, key: text([x])}


def test_thresholds_of_the_claims_about_filters() -> None:
    """On the false side of each number that a claim rests on, nothing is valid."""
    original = certificate(1e-3)
    of = of_node_1(original)

    def result(name: str, path: tuple[str, ...], value: Any, said: tuple[float, float] | None = None) -> str:
        altered = put(alone(original, of[name]), ("claims", 0, *path), value)
        if said is not None:
            claim = altered["claims"][0]
            claim["statement"] = claim["statement"].replace(repr(said[0]), repr(said[1]))
        return findings(altered)[0].result

    def number(name: str, *path: str) -> float:
        return float.fromhex(get(original, ("claims", of[name], *path)))

    error = number("steady-state", "gain_error")
    assert result("steady-state", ("gain_error",), text([error / 4]), (error, error / 4)) == "invalid"
    assert result("steady-state", ("gain_error",), text([error * 2]), (error, error * 2)) == "valid"
    theta = number("steady-state", "proof", "box", "theta")
    for factor in (1 - 1e-9, 1 + 1e-9):
        assert result("steady-state", ("proof", "box", "theta"), text([theta * factor])) == "invalid"
    rate = number("attraction", "rate")
    assert result("attraction", ("rate",), text([rate * 0.9]), (rate, rate * 0.9)) == "invalid"
    low, high = map(float.fromhex, original["claims"][of["tolerance"]]["interval"].split())
    assert result("tolerance", ("interval",), text([0.0, high]), (low, 0.0)) == "valid"
    assert result("tolerance", ("interval",), text([low, low * (1 - 1e-12)]), (high, low * (1 - 1e-12))) == "invalid"
    assert result("tolerance", ("interval",), text([high * (1 + 1e-12), 1.0]), (low, high * (1 + 1e-12))) == "invalid"
    radius = number("convergence", "proof", "radius")
    assert result("convergence", ("proof", "radius"), text([radius * 64])) == "invalid"
    assert result("convergence", ("proof", "radius"), text([radius / 2**40])) == "invalid"
    assert result("convergence", ("proof", "steps"), 1) == "invalid"
    lower = get(original, ("claims", of["convergence-all"], "proof", "lower"))
    assert result("convergence-all", ("proof", "upper"), lower) == "invalid"


def about_the_centre(problem: SensorNetwork, c: float, *names: str) -> Document:
    """What is decided of the centre's filter at c under these names; the gains may be those of another tolerance."""
    deployed, central = deployment_of(problem, centre=False), analysis.solve_steady_state(problem, c)
    states = SteadyStates(["centre"], [c], [central.P], [float(central.theta)], None)
    return document(deployed, *decide(states, deployed, names))


@cache
def overshooting() -> Document:
    """That a filter which oscillates by 1.6 a step does not attract."""
    drawn = random_network(np.random.default_rng(10), 3, 8, radius=1.02, relays=0.9)
    C, R = ([drawn.sensor(k)[part] for k in range(drawn.N)] for part in (0, 1))
    problem = SensorNetwork(A=drawn.A, Q=drawn.Q, C=C, R=R, adjacency=drawn.adjacency, ambiguity=Ambiguity(1e-3))
    return about_the_centre(problem, 50.0, "attraction")


def test_a_steady_state_that_does_not_attract_is_told_so() -> None:
    """The refutation is valid, and no other witness is."""
    original = overshooting()
    (claim,) = original["claims"]
    assert claim["verdict"] == "refuted"
    assert [f.result for f in findings(original)] == ["valid"]
    witness = claim["witness"]
    v = [float.fromhex(x) for x in witness["v"].split()]
    X = [float.fromhex(x) for x in witness["X"].split()]
    for altered in ({"v": text([0.0] * len(v))}, {"X": text([-x for x in X])}, {"v": text(v[:-1])}, {"X": "0x1p+0"}):
        found = {**original, "claims": [{**claim, "witness": witness | altered}]}
        assert [f.result for f in findings(found)] == ["invalid"]
    alike = certificate(1e-3)  # of one that attracts, another v or X says nothing
    i = of_node_1(alike)["attraction"]
    proof = alike["claims"][i]["proof"]
    claim = {key: x for key, x in alike["claims"][i].items() if key not in ("proof", "rate")}
    claim |= {"verdict": "refuted", "witness": {"box": proof["box"], "X": proof["Y"], "v": text([1.0, 0.0, 0.0])}}
    (found,) = findings({**alike, "claims": [claim]})
    assert (found.result, found.reason) == ("invalid", "J' X J - X > 0 was not shown")


def test_gains_further_away_than_is_claimed_are_refused() -> None:
    """Of a certificate that says 1e-9; gains of single precision are within 1e-6, and it may say so."""
    original = certificate(1e-3)
    i = next(
        i for i, claim in enumerate(original["claims"]) if claim["claim"] == "steady-state" and claim["node"] == 1
    )
    gains = [float.fromhex(x) for x in original["data"]["gains"][1].split()]
    size = max(map(abs, gains))
    said = float.fromhex(original["claims"][i]["gain_error"])

    def result(changed: list[float], error: float) -> str:
        found = put(alone(original, i), ("data", "gains", 1), text(changed))
        found = put(found, ("claims", 0, "gain_error"), text([error]))
        claim = found["claims"][0]
        claim["statement"] = claim["statement"].replace(
            f"within {said!r} of the stated one, relative to the",
            f"within {error!r} of the stated one, relative to the",
        )
        return findings(found)[0].result

    assert result(gains, 1e-9) == "valid"
    for j in range(len(gains)):
        moved = [x + 3e-9 * size * (k == j) for k, x in enumerate(gains)]
        assert result(moved, 1e-9) == "invalid"
        assert result(moved, 4e-9) == "valid"
    single = [float(np.float32(x)) for x in gains]
    assert result(single, 1e-9) == "invalid"
    assert result(single, 1e-6) == "valid"
    assert result([x + 3e-6 * size for x in single], 1e-6) == "invalid"


# -------------------- Slow filters, by blocks of a bracket ----------------------------------------------------


def slow(c: float, states: int) -> SensorNetwork:
    """One sensor that sees little of a mode of radius 0.999."""
    A, B = np.array([[0.999, 0.1], [0.0, 0.9]]), np.diag([1e-4 if states == 1 else 1e-3, 0.1])
    A, B, C = A[:states, :states], B[:states, :states], np.eye(1, states)
    return SensorNetwork(A=A, B=B, C=[C], R=[[[100.0]]], edges=[], name="slow", ambiguity=Ambiguity(c))


def proved_by_blocks(c: float, states: int, monkeypatch: pytest.MonkeyPatch) -> Document:
    """Its claim, with a bracket also where an orbit would be less work."""
    monkeypatch.setattr(convergence, "_WORTH", 0)
    found = about_the_centre(slow(c, states), c, "convergence")
    assert found["claims"][0]["proof"]["blocks"]
    return found


@pytest.mark.parametrize(("c", "states"), [(0.0, 1), (0.02, 1), (0.0, 2), (1e-9, 2)])
def test_slow_filters_are_shown_by_blocks(c: float, states: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what proves nothing is refused, as python-flint refuses it."""
    original = proved_by_blocks(c, states, monkeypatch)
    proof = original["claims"][0]["proof"]
    lower, upper = ([float.fromhex(x) for x in proof[key].split()] for key in ("lower", "upper"))
    valid = [{}, {"blocks": [*proof["blocks"], 40]}]
    refused: list[dict[str, Any]] = [
        {"lower": proof["upper"], "upper": proof["lower"]},
        {"lower": text([0.0 * x for x in lower])},
        {"lower": text([0.999 * x for x in upper])},
        {"upper": text([1.001 * x for x in lower])},
        {"upper": text([1e9 * x for x in upper])} if c else {"upper": text([-x for x in upper])},
        {"blocks": []},
        {"blocks": [0]},
    ]
    malformed: list[dict[str, Any]] = [
        *({"blocks": [*proof["blocks"], *x]} for x in ([-1], [41], [20] * 65)),
        *({"blocks": x} for x in (12, "12", None, {}, [True], [1.0], [[1]], ["1"])),
        *({"lower": x} for x in ("", "0x1p+0 " * 9, 3, None, ["0x1p+0"])),
        {"box": {}},
        {"further": 1},
    ]
    for altered in (*valid, *refused, *malformed):
        found = put(original, ("claims", 0, "proof"), proof | altered)
        expected = altered in valid
        assert [f.result == "valid" for f in findings(found)] == [expected], altered
        assert said_in_balls(found) == [expected], altered
    for missing in ("lower", "upper", "blocks"):
        found = put(original, ("claims", 0, "proof"), {key: x for key, x in proof.items() if key != missing})
        assert [f.result for f in findings(found)] == ["invalid"]
        assert said_in_balls(found) == [False]


def test_many_steps_at_once_are_those_one_by_one() -> None:
    """T^m in fractions, in units 2^10 apart; F = 0 in the end is no number of a million digits."""
    A = matrix_of([[Fraction(7, 8), Fraction(64)], [Fraction(0), Fraction(1, 2)]])
    Q, S = (
        matrix_of([[Fraction(x), Fraction(0)], [Fraction(0), Fraction(y)]]) for x, y in ((1024, 1), (1 / 1024, 2))
    )
    one = checker.unit(2)
    equations = filters.Equations(
        arithmetic.exact(A), arithmetic.exact(Q), arithmetic.exact(S), arithmetic.exact(one), Fraction(1)
    )
    theta, P = arithmetic.exactly(Fraction(1, 2**16)), arithmetic.exact(one)
    start, each = P, P
    for doublings in range(5):
        found = filters.many_steps(equations, theta, start, doublings)
        if doublings:
            for _ in range(2 ** (doublings - 1)):
                each = equations.following(equations.at(each, theta, stretched=False))
        else:
            each = equations.following(equations.at(each, theta, stretched=False))
        apart = found - each
        assert hold(apart, [[Fraction(0)] * 2] * 2)
        assert arithmetic.largest(apart.radius) < Fraction(1, 2**180)
    end = filters.many_steps(equations, theta, start, 40)
    assert hold(end - equations.following(equations.at(end, theta, stretched=False)), [[Fraction(0)] * 2] * 2)
    assert arithmetic.largest(end.radius) < Fraction(1, 2**100)


def of_one(x: float) -> Matrix:
    return matrix_of([[Fraction(x)]])


def plain(n: int, c: float, S: float = 1.0) -> filters.Equations:
    """A = I / 2, Q = I, S of this size."""
    one = arithmetic.unit(n)
    return filters.Equations(
        one.times(arithmetic.exactly(0.5)), one, one.times(arithmetic.exactly(S)), one, Fraction(c)
    )


def test_each_condition_on_a_bracket_counts() -> None:
    """T(P) = P / (4 (1 + P)) + 1 has its fixed point at 1.13; at c > 0, theta lies between those of the ends."""
    equations = plain(1, 0.0)

    def ends(low: float, P: float, high: float) -> tuple[Balls, Balls]:
        way = filters.Bracket(of_one(low), of_one(high), [1])
        return filters.by_blocks(equations, arithmetic.exact(of_one(P)), way)

    assert ends(1, 1.5, 2)[0].entry(0, 0).low > 1
    for low, P, high in ((1, 3, 2), (1, 0.5, 2), (-1, 1.5, 2)):
        with pytest.raises(Wrong, match="between the ends"):
            ends(low, P, high)
    with pytest.raises(Wrong, match="L < T"):
        ends(1.25, 1.5, 2)
    with pytest.raises(Wrong, match=r"T\(U, theta\(L\)\) < U"):
        ends(1, 1.0625, 1.125)
    L, U = (arithmetic.unit(2).times(arithmetic.exactly(x)) for x in (1, 2))
    (_, a), (_, b) = filters.bounds(plain(2, 0.01), L, U)
    theta_L, theta_U = (filters.enclose_theta(plain(2, 0.01), M) for M in (L, U))
    assert a.high <= theta_U.low < theta_L.high <= b.low
    with pytest.raises(Wrong, match="U\\^-1 - theta"):
        filters.bounds(plain(2, 1.0, 2.0**-10), L.times(arithmetic.exactly(2.0**-6)), U)


@pytest.mark.parametrize("bits", [24, 40])
def test_the_ends_of_a_bracket_are_rounded_outward(bits: int) -> None:
    with arithmetic.precision(bits):
        way = filters.Bracket(of_one(1), of_one(2), [1])
        found = filters.by_blocks(plain(1, 0.0), arithmetic.exact(of_one(1.5)), way)
    for M, x, sign in zip(found, (Fraction(1), Fraction(2)), (1, -1), strict=True):
        end = x
        for _ in range(2):
            end = end / (4 * (1 + end)) + 1
        end -= (end - x) / 2**12
        assert 0 < sign * (end - M.entry(0, 0).middle) < Fraction(1, 2 ** (bits - 6))


def test_a_claim_that_takes_too_long_leaves_time_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters, "LONGEST", -1)
    found = findings(certificate(1e-3))
    assert {(f.result, f.reason) for f in found} == {("not checked here", "the claim takes more than -1 seconds")}
    assert "need tolnet check: the claim takes more than -1 seconds" in "\n".join(checker.summary(found))
    monkeypatch.setattr(checker, "LONGEST", 10**6)
    monkeypatch.setattr(filters, "LONGEST", 10**6)
    assert {f.result for f in findings(alone(certificate(1e-3), 0))} == {"valid"}


@pytest.mark.parametrize("name", [*FILTER_CLAIMS, "blocks", "refuted"])
def test_a_malformed_certificate_is_no_traceback(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what is valid all the same is valid in python-flint."""
    if name in FILTER_CLAIMS:
        intact = alone(certificate(1e-3), of_node_1(certificate(1e-3))[name])
    else:
        intact = proved_by_blocks(1e-9, 2, monkeypatch) if name == "blocks" else overshooting()
    rng, path, refused = random.Random(name), tmp_path / "c.json", 0
    for _ in range(SPOILT):
        what, content = spoilt(intact, rng)
        path.write_bytes(content)
        code = checker.main([str(path)], more=filters.RULES)
        assert code in (0, 1, 2, 3), what
        refused += code != 0
        assert code != 0 or all(said_in_balls(json.loads(content))), what
    assert refused >= 0.8 * SPOILT
