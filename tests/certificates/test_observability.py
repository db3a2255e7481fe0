"""Robust observability: exact proofs and refutations, from both sides of the truth, and against altered numbers."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.certificates.alterations import branches, get, numbers, put
from tests.reference.observability_truth import exceeds, is_true

from tolnet import analysis, model
from tolnet.analysis.second_moment import second_moment_limit
from tolnet.certificates import check as checker
from tolnet.certificates import statements
from tolnet.certificates.check import Refused, check
from tolnet.certificates.observability import (
    Claimed,
    channels_data,
    prove_observability,
    refute_observability,
)
from tolnet.certificates.verdicts import Proved, Refuted, Undecided
from tolnet.model import CorruptedNetwork

Document = dict[str, Any]


def one_state(a: float = 0.5, *, Pi_0: float = 1.0, mu: float = 0.25, N: int = 2) -> CorruptedNetwork:
    """One state, seen by a fading sensor and, for N = 2, by one that does not fade."""
    return CorruptedNetwork(
        A=[[a]],
        Q=[[1.0]],
        F=[[0.5]],
        multiplicative_variance=mu,
        C=[[[2.0]], [[0.25]]][:N],
        R=[[[0.5]], [[3.0]]][:N],
        fading_mean=[0.5, 1.0][:N],
        fading_variance=[0.25, 0.0][:N],
        initial_second_moment=[[Pi_0]],
        edges=[[0, 1]][: N - 1],
    )


def two_states(*, fading: float = 0.125, scale: float = 1.0) -> CorruptedNetwork:
    """A sensor with two outputs, a relay, and one whose C has a period of 3; A has one of 2."""
    s = np.diag([scale, 1 / scale])
    inverse = np.diag([1 / scale, scale])
    A = [s @ np.array(A) @ inverse for A in ([[0.75, 0.5], [-0.25, 1.25]], [[0.5, 0.0], [0.375, 1.0]])]
    C = [np.array(C) @ inverse for C in ([[1.0, 0.0]], [[0.0, 0.5]], [[1.0, -1.0]])]
    return CorruptedNetwork(
        A=A,
        Q=s @ np.array([[1.0, 0.25], [0.25, 0.5]]) @ s,
        F=s @ np.array([[0.25, 0.0], [0.5, 0.125]]) @ inverse,
        multiplicative_variance=[0.5, 0.25],
        C=[np.array([[1.0, 0.5], [0.25, -1.0]]) @ inverse, np.zeros((0, 2)), C],
        R=[[[1.0, 0.25], [0.25, 2.0]], np.zeros((0, 0)), [[0.5]]],
        fading_mean=[0.5, 1.0, 1.0 if fading == 0 else 0.75],
        fading_variance=[fading, 0.0, fading],
        initial_second_moment=s @ np.array([[2.0, 0.5], [0.5, 1.0]]) @ s,
        edges=[[0, 1], [1, 2]],
    )


def blind() -> CorruptedNetwork:
    """Nobody sees (1, 1) in two instants from k = 1 on."""
    return CorruptedNetwork(
        A=[[[0.5, 0.25], [0.25, 0.5]], [[0.5, 0.25], [0.25, 0.5]]],
        Q=np.eye(2),
        C=[[[[1.0, 0.0]], [[1.0, -1.0]], [[1.0, -1.0]]], [[0.5, -0.5]]],
        R=[[[1.0]], [[2.0]]],
        fading_mean=0.5,
        fading_variance=0.25,
        edges=[[0, 1]],
    )


def document(network: CorruptedNetwork, verdict: Proved | Refuted | Undecided) -> Document:
    labels = dict.fromkeys(("tolnet", "problem", "convention", "tau", "tolerance", "status"))
    made = {"schema": checker.SCHEMA, **labels, "data": channels_data(network), "claims": [verdict.entry()]}
    return json.loads(json.dumps(made))


def decided(network: CorruptedNetwork, claimed: Claimed) -> Proved | Refuted | Undecided:
    """As the command line does it."""
    form, window, horizon = claimed.form, claimed.window, claimed.horizon
    found = analysis.robust_observability(network, form=form, window=window, horizon=horizon)
    if not found.holds:
        return refute_observability(network, claimed)
    limit = second_moment_limit(network)
    return prove_observability(network, claimed, found.alpha, limit.Pi if limit.bounded else None)


CASES = {
    "one state, every k": (one_state(), Claimed(1, None)),
    "one state, two instants": (one_state(), Claimed(2, None)),
    "one fading sensor": (one_state(N=1), Claimed(1, None)),
    "a first moment above the limit": (one_state(0.25, Pi_0=64.0, N=1), Claimed(1, None)),
    "one state, a growing moment": (one_state(1.5), Claimed(2, None)),
    "one state, classical": (one_state(), Claimed(1, None, "classical")),
    "two states, finite": (two_states(), Claimed(2, 4)),
    "two states, all of the horizon": (two_states(), Claimed(3, 2)),
    "two states, no fading": (two_states(fading=0.0), Claimed(2, None)),
    "two states, classical": (two_states(), Claimed(2, None, "classical")),
}


@cache
def _proof(name: str) -> Document:
    network, claimed = CASES[name]
    verdict = decided(network, claimed)
    assert isinstance(verdict, Proved), getattr(verdict, "reason", "")
    return document(network, verdict)


def proof(name: str) -> Document:
    return copy.deepcopy(_proof(name))


def results(made: Document) -> list[tuple[str, str | None]]:
    return [(finding.result, finding.reason) for finding in check(made)]


def with_alpha(made: Document, alpha: float) -> Document:
    made = copy.deepcopy(made)
    claim = made["claims"][0]
    old = float.fromhex(claim["alpha"])
    claim["alpha"] = alpha.hex()
    claim["statement"] = claim["statement"].replace(repr(old), repr(alpha))
    return made


@pytest.mark.parametrize("name", CASES)
def test_what_is_proved_is_valid_and_true(name: str):
    made = proof(name)
    assert results(made) == [("valid", None)]
    assert is_true(made["data"], made["claims"][0])


@pytest.mark.parametrize("name", CASES)
def test_alpha_just_inside_the_truth_is_proved_and_just_outside_refused(name: str):
    """The truth by bisection, each step of it exact."""
    made = proof(name)
    data, keys = made["data"], [made["claims"][0][key] for key in ("window", "form", "horizon")]
    proved = float.fromhex(made["claims"][0]["alpha"])
    inside, outside = proved, 2 * proved
    while inside < (middle := (inside + outside) / 2) < outside:
        inside, outside = (middle, outside) if exceeds(data, Fraction(middle), *keys) else (inside, middle)
    slack = 2e-6 if "every k" in name or "limit" in name or "one fading" in name or "two instants" in name else 1e-9
    assert proved >= (1 - slack) * inside
    assert results(with_alpha(made, outside))[0][0] == "invalid"
    assert results(with_alpha(made, proved * (1 - 1e-3))) == [("valid", None)]


def test_a_transient_ends_in_a_loop_and_a_growing_moment_needs_none():
    transient = proof("a first moment above the limit")["claims"][0]["proof"]
    assert transient["loop"] == 1 < len(transient["moments"]) < 30
    assert len(proof("one state, every k")["claims"][0]["proof"]["moments"]) == 1
    growing = proof("one state, a growing moment")["claims"][0]["proof"]
    assert growing["moments"] is None
    assert growing["gains"][0][0] == "0x0p+0"


def test_what_does_not_fade_proves_what_it_sees_alone():
    """The growth is along one of two states: of two outputs that fade, floating point still counts a combination."""
    C = np.array([[4.0, 1.0], [0.0, 4.0]])
    network = CorruptedNetwork(
        A=[[1.25, 0.0], [0.0, 0.5]],
        Q=np.eye(2),
        C=[C, np.eye(2) / 16],
        R=[np.eye(2), np.eye(2)],
        fading_mean=[0.75, 1.0],
        fading_variance=[0.125, 0.0],
        edges=[[0, 1]],
    )
    verdict = decided(network, Claimed(1, None))
    assert isinstance(verdict, Proved)
    assert float.fromhex(verdict.keys["alpha"]) == pytest.approx(2.0**-8, rel=1e-9)
    assert results(document(network, verdict)) == [("valid", None)]


def test_an_overflow_is_no_proof():
    """Over 700 instants the Gramian is beyond doubles in one direction."""
    network = CorruptedNetwork(A=[[3.0, 0.0], [0.0, 0.5]], Q=np.eye(2), C=[np.eye(2)], R=[np.eye(2)], edges=[])
    with np.errstate(over="ignore"):
        verdict = prove_observability(network, Claimed(700, None), 1.0, None)
    assert isinstance(verdict, Proved)
    assert results(document(network, verdict)) == [("valid", None)]


def test_states_in_very_different_units():
    network = two_states(scale=1e5)
    verdict = decided(network, Claimed(2, 4))
    assert isinstance(verdict, Proved)
    made = document(network, verdict)
    assert results(made) == [("valid", None)]
    assert is_true(made["data"], made["claims"][0])


@pytest.mark.parametrize("seed", range(6))
def test_random_networks(seed: int):
    rng = np.random.default_rng(seed)
    n, N, H = 2 + seed % 2, 2, int(rng.integers(2, 5))
    network = CorruptedNetwork(
        A=rng.normal(size=(1 + seed % 3, n, n)),
        Q=np.eye(n) / 4,
        F=rng.normal(size=(n, n)) / 2,
        multiplicative_variance=0.5,
        C=rng.normal(size=(N, 2, n)),
        R=np.broadcast_to(np.eye(2) / 3, (N, 2, 2)).copy(),
        fading_mean=0.6,
        fading_variance=0.1,
        edges=[[0, 1]],
    )
    verdict = decided(network, Claimed(2, H))
    assert isinstance(verdict, Proved)
    made = document(network, verdict)
    assert results(made) == [("valid", None)]
    assert is_true(made["data"], made["claims"][0])


def test_a_direction_that_nobody_sees_is_a_refutation():
    network = blind()
    verdict = decided(network, Claimed(2, None))
    assert isinstance(verdict, Refuted)
    v = [float.fromhex(x) for x in verdict.witness["vector"].split()]
    assert verdict.witness["start"] == 1
    assert v[0] == v[1] != 0
    made = document(network, verdict)
    assert results(made) == [("valid", None)]
    assert is_true(made["data"], made["claims"][0])
    assert isinstance(decided(network, Claimed(3, None)), Proved)
    assert isinstance(decided(network, Claimed(2, 5)), Refuted)
    assert isinstance(decided(network, Claimed(2, 1)), Proved)  # 0, 1 is the only window


def test_the_neighbours_of_a_blind_network_are_no_refutation():
    """One unit in the last place of one number, and the window sees everything."""
    network = blind()
    made = document(network, decided(network, Claimed(2, None)))
    for place in ("0x1p-1 0x1p-2", "0x1p-2 0x1p-1"):
        other = copy.deepcopy(made)
        other["data"]["A"][1] = other["data"]["A"][1].replace(place, place.replace("0x1p-1", (0.5 + 2.0**-53).hex()))
        assert other["data"]["A"][1] != made["data"]["A"][1]
        assert results(other)[0][0] == "invalid"


def test_a_null_direction_that_is_no_vector_of_doubles_is_undecided():
    """[1/3, 1/7, 0.1] after one step of a full A leaves one direction, whose whole numbers are too long."""
    A = np.array([[0.3, 0.7, 0.1], [0.1, 0.9, 0.2], [0.4, 0.2, 0.7]])
    network = CorruptedNetwork(A=A, Q=np.eye(3), C=[[[1 / 3, 1 / 7, 0.1]]], R=[[[1.0]]], edges=[])
    verdict = refute_observability(network, Claimed(2, None))
    assert isinstance(verdict, Undecided)
    assert "no vector of doubles" in verdict.reason
    assert isinstance(refute_observability(network, Claimed(1, None)), Refuted)
    assert results(document(network, verdict)) == [("undecided", verdict.reason)]


def test_functions_of_k_are_refused():
    network = CorruptedNetwork(
        A=lambda k: np.array([[0.5 + 0.1 * (k % 2)]]), Q=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], edges=[]
    )
    with pytest.raises(model.UnsupportedError, match="function of k"):
        channels_data(network)
    with pytest.raises(model.UnsupportedError, match="function of k"):
        prove_observability(network, Claimed(1, 3), 1.0, None)


# -------------------- Alterations -----------------------------------------------------------------------------


def altered(made: Document) -> Iterator[tuple[str, Document]]:
    """Every number of the certificate, one at a time, made a little or much larger or smaller, zero, or negative."""
    changes = {
        "opposite": lambda x: -x,
        "tenfold": lambda x: 10 * x,
        "half": lambda x: x / 2,
        "a bit more": lambda x: x * (1 + 2.0**-20),
        "a bit less": lambda x: x * (1 - 2.0**-20),
        "one": lambda x: 1.0,
    }
    for path in numbers(made):
        words = get(made, path).split()
        for i, word in enumerate(words):
            x = float.fromhex(word)
            for name, change in changes.items():
                y = change(x)
                if y != x:
                    other = put(made, path, " ".join([*words[:i], y.hex(), *words[i + 1 :]]))
                    if path[-1] == "alpha" and y > 0:
                        other = with_alpha(made, y)
                    yield f"{path}[{i}] {name}", other
    claim = made["claims"][0]
    for key, values in {"window": (1, 2, 3, 4), "horizon": (None, 0, 1, 2, 3, 5, 50), "form": FORMS}.items():
        for value in values:
            other = put(made, ("claims", 0, key), value)
            yield f"{key} = {value}", restated(other)
    for key, values in {
        "loop": (0, 1, 2, 3, 6),
        "moments": (None, []),
        "gains": ([], None),
        "start": range(4),
    }.items():
        for evidence in ("proof", "witness"):
            if key in claim.get(evidence, {}):
                for value in values:
                    yield f"{key} = {value}", put(made, ("claims", 0, evidence, key), value)
    for path in branches(made):
        thing = get(made, path)
        if isinstance(thing, list) and path:
            for i in range(len(thing)):
                yield f"{path} without {i}", put(made, path, thing[:i] + thing[i + 1 :])
                yield f"{path} with {i} twice", put(made, path, [*thing[: i + 1], *thing[i:]])
            yield f"{path} turned", put(made, path, thing[::-1])


FORMS = ("sharp", "classical")


def restated(made: Document) -> Document:
    """With the sentence that the keys of the claim lead to, where they lead to one."""
    claim = made["claims"][0]
    window = {key: claim[key] for key in ("window", "form", "horizon")}
    refuted = claim["verdict"] == "refuted"
    text = (
        statements.blindness(**window)
        if refuted
        else statements.observability(float.fromhex(claim["alpha"]), **window)
    )
    return put(made, ("claims", 0, "statement"), text)


@pytest.mark.parametrize("name", [*list(CASES)[:7], "two states, no fading", "blind"])
def test_no_alteration_is_accepted_unless_it_is_true(name: str):
    made = document(blind(), decided(blind(), Claimed(2, None))) if name == "blind" else proof(name)
    tried = refused = 0
    for what, other in altered(made):
        tried += 1
        try:
            found = results(other)
        except Refused:
            refused += 1
            continue
        if all(result == "valid" for result, _ in found):
            for claim in other["claims"]:
                assert is_true(other["data"], claim), what
        else:
            refused += 1
    assert tried > 100
    assert refused > tried / 5


@pytest.mark.parametrize(
    ("name", "path", "value", "complaint"),
    [
        ("one state, every k", ("moments", 0), "0x1p+0", "less the initial second moment"),
        ("one state, every k", ("moments", 0), "0x1.2p+0", "the bound of the second moment after 0"),
        ("one state, every k", ("moments",), None, "sensor 0 fades, and there are no moments"),
        ("one state, every k", ("gains", 0, 0), "0x1p+10", "the Gramian of the window from 0"),
        ("one state, every k", ("gains", 0, 0), "0x0p+0", "the Gramian of the window from 0"),
        ("one state, every k", ("gains",), [], "proof.loop: expected a whole number from 0 to 0"),
        ("one state, every k", ("loop",), 0, "the gains end before the claim does"),
        ("two states, no fading", ("loop",), 3, "a multiple of the period"),
        ("two states, finite", ("moments", 3), "0x1p+0 0x0p+0 0x1p+0", "the bound of the second moment after 2"),
    ],
)
def test_every_condition_is_needed(name: str, path: tuple[str | int, ...], value: Any, complaint: str):
    result, reason = results(put(proof(name), ("claims", 0, "proof", *path), value))[0]
    assert result == "invalid"
    assert complaint in str(reason)


def test_a_witness_lies_within_the_horizon():
    made = document(blind(), decided(blind(), Claimed(2, 3)))
    assert results(made) == [("valid", None)]
    assert results(put(made, ("claims", 0, "witness", "start"), 3))[0][0] == "invalid"
    assert results(put(made, ("claims", 0, "witness", "start"), 0)) == [
        ("invalid", "sensor 0 sees the vector of the witness at 0")
    ]
    assert results(put(made, ("claims", 0, "witness", "vector"), "0x0p+0 0x0p+0"))[0][0] == "invalid"


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        (("data", "kind"), "other", "data.kind"),
        (("data", "A"), [], "data.A: expected one period"),
        (("data", "mu"), ["-0x1p-2"], "data.mu"),
        (("data", "phi"), ["-0x1p-2 0x0p+0"], "data.phi"),
        (("data", "R", 0, 0), "-0x1p-1", "data.R"),
        (("data", "Q", 0), "-0x1p-1", "is not semidefinite"),
        (("data", "initial_second_moment"), "-0x1p-1", "is not semidefinite"),
        (("data", "tau"), ["0x1p+0"], "data.tau"),
        (("data", "C"), [["0x1p+0", "0x1p+0"], ["0x1p+0 0x1p+0", "0x1p+0"]], "changes its number of outputs"),
        (("data", "extra"), 1, "unknown key"),
    ],
)
def test_data_that_fit_no_network_are_refused(path: tuple[str | int, ...], value: Any, complaint: str):
    made = put(proof("one state, every k"), path, value)
    with pytest.raises(Refused, match=complaint):
        check(made)


def test_covariances_are_symmetric():
    for key, text, turned in (
        ("R", "0x1p+0 0x1p-2 0x1p-2 0x1p+1", "0x1p+0 0x1p-2 0x1p-3 0x1p+1"),
        ("Q", "0x1p+0 0x0p+0 0x0p+0 0x1p+0", "0x1p+0 0x0p+0 0x1p-9 0x1p+0"),
    ):
        made = proof("two states, finite")
        made["data"]["Q"] = ["0x1p+0 0x0p+0 0x0p+0 0x1p+0"]
        for given, refused in ((text, False), (turned, True)):
            if key == "R":
                made["data"]["R"][0][0] = given
            else:
                made["data"]["Q"] = [given]
            if refused:
                with pytest.raises(Refused, match="is not symmetric"):
                    check(made)
            else:
                check(made)


def test_a_second_moment_may_be_singular():
    """Pi_0 = diag(0, 1/2) is semidefinite, [[0, 1], [1, 1]] is not."""
    made = proof("two states, finite")
    assert results(put(made, ("data", "initial_second_moment"), "0x0p+0 0x0p+0 0x1p-1")) == [("valid", None)]
    with pytest.raises(Refused, match="is not semidefinite"):
        check(put(made, ("data", "initial_second_moment"), "0x0p+0 0x1p+0 0x1p+0"))


def test_a_claim_of_the_other_kind_of_data_is_invalid():
    made = proof("one state, every k")
    made["claims"][0] |= {"claim": "schur-stability", "block": "network"}
    for key in ("alpha", "window", "form", "horizon"):
        del made["claims"][0][key]
    assert results(made)[0] == ("invalid", "the claim speaks of another kind of data")


def test_a_window_beyond_all_means_is_declined(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(checker, "LONGEST", 1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    made = restated(put(proof("one state, every k"), ("claims", 0, "window"), 10**6))
    assert results(made)[0][0] == "not checked here"
