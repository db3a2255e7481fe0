"""Hostile input is refused by a clear message, in bounded time and memory, and never runs anything."""

from __future__ import annotations

import json
import random
import resource
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from tests.certificates.alterations import branches, get, put
from tests.certificates.examples import certificate, certificates
from tests.reference.certificates import (
    document,
    said_performance,
    said_stable,
    said_switching,
    scalar_data,
    stability_claim,
    text,
)

from tolnet.certificates import check as checker
from tolnet.certificates.check import Refused, check, load, main

PLAIN = json.dumps(certificate("primal network"))


def complaint(tmp_path: Path, content: bytes, largest: int = checker.LARGEST_FILE) -> str:
    """The message that refuses such a file."""
    file = tmp_path / "certificate.json"
    file.write_bytes(content)
    with pytest.raises(Refused) as caught:
        load(str(file), largest)
    return str(caught.value)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "no JSON document"),
        (b"{", "no JSON document"),
        (b"\xff\xfe{}", "no JSON document"),
        (b"\xef\xbb\xbf{}", "no JSON document"),
        (b'{"claims": [NaN]}', "NaN is no finite double"),
        (b'{"claims": [-Infinity]}', "-Infinity is no finite double"),
        (b'{"claims": 1e999}', "no finite double"),
        (b'{"claims": -1e999}', "no finite double"),
        (b'{"claims": 1' + b"0" * 40 + b"}", "no finite double"),
        (b'{"claims": ' + b"9" * 1_000_000 + b"}", "no finite double"),
        (b'{"claims": 0.' + b"1" * 1_000_000 + b"}", "no finite double"),
        (b'{"a": 1, "a": 1}', "key twice"),
        (b"[" * 50_000, "nested too deeply"),
        (b'{"a":' * 50_000, "nested too deeply"),
        (b"[" * 50_000 + b"]" * 50_000, "nested too deeply"),
    ],
)
def test_what_is_no_plain_json_is_refused(tmp_path: Path, content: bytes, says: str) -> None:
    assert says in complaint(tmp_path, content)


def test_a_file_that_is_too_large_is_not_read_to_its_end(tmp_path: Path) -> None:
    assert "larger than 100 bytes" in complaint(tmp_path, PLAIN.encode(), 100)
    assert "larger than" in complaint(tmp_path, b" " * 101, 100)
    file = tmp_path / "exact.json"
    file.write_text("{}" + " " * 98)
    assert load(str(file), 100) == {}
    with pytest.raises(Refused, match="larger than 1000 bytes"):
        load("/dev/zero", 1000)  # no end at all
    with pytest.raises(Refused):
        load(str(tmp_path))


@pytest.mark.parametrize("thing", [None, True, 3, "text", [], {}, {"schema": "tolnet.certificate/1"}, [[[[]]]]])
def test_what_is_no_certificate_is_refused(thing: Any) -> None:
    with pytest.raises(Refused):
        check(thing)


@pytest.mark.parametrize("key", ["schema", "tolnet", "problem", "tau", "status", "data", "claims"])
def test_every_key_of_the_document_is_needed_and_no_other(key: str) -> None:
    found = certificate("primal network")
    with pytest.raises(Refused, match=key):
        check({k: v for k, v in found.items() if k != key})
    with pytest.raises(Refused, match="unknown key 'more'"):
        check({**found, "more": 1})


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("schema",), "tolnet.certificate/2", "schema"),
        (("claims",), [], "claims nothing"),
        (("claims",), {}, "claims: expected a list"),
        (("data", "n"), 0, "data.n"),
        (("data", "n"), 10**9, "data.n"),
        (("data", "n"), True, "data.n"),
        (("data", "n"), 2.0, "data.n"),
        (("data", "nodes"), -1, "data.nodes"),
        (("data", "nodes"), 10**12, "a list of 1000000000000"),
        (("data", "directed"), 0, "data.directed"),
        (("data", "neighbours"), [[0, 1, 2]] * 2, "data.neighbours: expected a list of 3"),
        (("data", "neighbours", 1), [0, 2], "the node itself"),
        (("data", "neighbours", 1), [1, 0, 2], "rising"),
        (("data", "neighbours", 1), [0, 1, 1, 2], "rising"),
        (("data", "neighbours", 1), [0, 1, 3], "data.neighbours[1]"),
        (("data", "neighbours", 1), [-1, 0, 1], "data.neighbours[1]"),
        (("data", "neighbours", 1), [False, 1, 2], "data.neighbours[1]"),
        (("data", "neighbours", 1), [0, 1], "one way only"),
        (("data", "A"), "0x1.0000000000000p+0 " * 4, "data.A"),
        (("data", "A"), "0x1.0000000000000p+0", "data.A"),
        (("data", "A"), "0x1p0 0x1p0 0x1p0 0x1p0", "data.A"),
        (("data", "A"), "1 0 0 1", "data.A"),
        (("data", "A"), "nan nan nan nan", "data.A"),
        (("data", "A"), "inf inf inf inf", "data.A"),
        (("data", "A"), "0x1.0000000000000p+5000 " + text([0, 0, 0]), "data.A"),
        (("data", "A"), " " * 10**6, "data.A"),
        (("data", "A"), [1, 0, 0, 1], "data.A"),
        (("data", "A"), None, "data.A"),
        (("data", "C", 0), text([1.0]), "data.C[0]"),
        (("data", "noise", 0), {}, "data.noise[0]"),
        (("data", "noise", 0), {"R": text([1]), "D": text([1])}, "data.noise[0]"),
        (("data", "noise", 1), {"R": text([1, 2, 3, 1])}, "symmetric"),
        (("data", "process"), {"Q": text([1, 2, 3, 4])}, "symmetric"),
        (("data", "process"), {"B": text([1, 2]), "columns": 2}, "data.process.B"),
        (("data", "process"), {"B": "", "columns": -1}, "data.process.columns"),
        (("data", "process"), {}, "data.process"),
        (("data", "weights", 0), "", "data.weights[0]"),
        (("data", "gains", 0), "", "data.gains[0]"),
        (("data", "centre"), {}, "data.centre"),
        (("data", "centre"), [], "data.centre"),
    ],
)
def test_data_that_do_not_fit_are_refused(path: tuple[str | int, ...], value: Any, says: str) -> None:
    with pytest.raises(Refused) as caught:
        check(put(certificate("primal network"), path, value))
    assert says in str(caught.value)


ODD = [None, True, False, 0, -1, 10**15, 0.5, "", " ", "0x", "\x1b[2J", "\ud800", [], [[]], {}, {"a": {}}]


@pytest.mark.parametrize("name", [*certificates()][::6])
def test_nothing_but_a_refusal_or_a_finding_comes_out(name: str) -> None:
    """Odd things in the place of everything: no other exception, and nothing valid without its proof."""
    original = certificate(name)
    for path in branches(original):
        if path:
            for odd in ODD:
                altered = put(original, path, odd)
                try:
                    findings = check(altered)
                except Refused:
                    continue
                assert len(findings) == len(altered["claims"])
                if path[:3] == ("claims", 0, "proof") and "scenarios" not in name:
                    assert all(finding.result != "valid" for finding in findings) or get(original, path) == odd


def test_messages_of_hostile_files_are_plain_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "certificate.json"
    found = certificate("primal network")
    found["claims"][0] |= {"claim": "\x1b[31m\ud800" * 10_000, "statement": "\n\nvalid: all of it\n" * 1000}
    file.write_text(json.dumps(found))
    for arguments in ([str(file)], [str(file), "--json"]):
        assert main(arguments) == 1
        printed = capsys.readouterr().out
        assert printed.isascii()
        assert "\x1b" not in printed
        assert len(printed) < 10_000
    assert main([str(file)]) == 1
    assert [line[:9] for line in capsys.readouterr().out.splitlines()][:2] == ["invalid: ", "summary: "]
    file.write_text(json.dumps({**certificate("primal network"), "\x1b[2J" * 1000: 1}))
    assert main([str(file)]) == 2
    assert "\x1b" not in capsys.readouterr().err


def test_too_many_sets_of_links_are_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A star of 60 nodes, of which any 30 links may drop."""
    monkeypatch.setattr(checker, "LONGEST", 1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    nodes = 60
    data = {**scalar_data(0.1), "nodes": nodes, "C": [""] * nodes, "noise": [{}] * nodes, "gains": [""] * nodes}
    data["neighbours"] = [list(range(nodes))] + [[0, k] for k in range(1, nodes)]
    data["weights"] = [text([1 / len(heard)] * len(heard)) for heard in data["neighbours"]]
    said = said_switching({"drop": 30})
    claim = {"claim": "switching", "verdict": "proved", "statement": said, "margin": 0.0, "reason": None, "drop": 30}
    started = time.monotonic()
    finding = check(document(data, claim | {"proof": {"Y": [text([1.0])] * nodes}}))[0]
    assert finding.result == "not checked here"
    assert finding.reason == "the document takes more than 1 seconds"
    assert time.monotonic() - started < 20


@pytest.mark.parametrize("zero", [False, True])
def test_too_many_steps_are_not_checked(monkeypatch: pytest.MonkeyPatch, zero: bool) -> None:
    """A power of 10^15, of links that weigh nothing as well."""
    monkeypatch.setattr(checker, "LONGEST", 1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    found = certificate("power network")
    found["claims"][0]["proof"]["power"] = 10**15
    if zero:
        heard = found["data"]["neighbours"]
        found["data"]["weights"] = [text([float(l == k) for l in each]) for k, each in enumerate(heard)]
    assert check(found)[0].result == "not checked here"


def test_many_scenarios_are_not_checked_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checker, "LONGEST", 1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    found = certificate("scenarios")
    gains = found["data"]["gains"]
    claim = found["claims"][0]
    claim["scenarios"] = [{"gains": gains}] * 10**5
    assert check(found)[0].result == "not checked here"
    claim["scenarios"] = [{}] * 10**4
    assert check(found)[0].result == "invalid"  # of 5 scenarios, says the statement


def test_every_claim_counts_against_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    found = certificate("rate primal")
    claim = found["claims"][0]
    rates = [float.fromhex(claim["rate"]) + 2.0**-40 * i for i in range(10**4)]  # of each, something else is claimed
    found["claims"] = [
        {**claim, "rate": rate.hex(), "statement": said_stable(claim["block"], rate)} for rate in rates
    ]
    monkeypatch.setattr(checker, "LONGEST", 1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    results = [finding.result for finding in check(found)]
    assert results[0] == "valid"
    assert set(results) == {"valid", "not checked here"}
    assert results == sorted(results, reverse=True)  # once it is over, it is over


def test_matrices_over_too_many_nodes_are_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("full network", "performance", "lyapunov"):
        found = certificate(name)
        monkeypatch.setattr(checker, "LARGEST_MATRIX", 5)
        assert [finding.result for finding in check(found)] == ["not checked here"]
        monkeypatch.setattr(checker, "LARGEST_MATRIX", 8)
        assert [finding.result for finding in check(found)] == ["valid"]


def test_data_that_take_too_long_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checker, "LONGEST", -1)
    monkeypatch.setattr(checker.Clock, "end", checker.Clock.end)  # put back afterwards
    with pytest.raises(Refused, match="more than -1 seconds"):
        check(certificate("performance, relays"))


def test_a_wide_tilt_takes_little_memory() -> None:
    """A factor of T with 20,000 columns: the matrices of a proof have as many rows as the network has states."""
    columns = 20_000
    gain = {"gain": [""], "tilt": " ".join([(2.0**-9).hex()] * columns), "columns": columns}
    data, wide = {**scalar_data(0.5), "centre": gain}, text([-9.0, 9.0])
    said = said_performance(-9.0, 9.0)
    claim = {"claim": "performance", "verdict": "proved", "statement": said, "margin": None, "reason": None}
    claim |= {"nodes": [wide], "centre": wide, "network": wide}
    proof = {"Q": text([1.0, 1.0, 1.5]), "Y": [text([2.0]), text([100.0])], "delta": text([0.125])}
    tracemalloc.start()
    found = check(document(data, {**claim, "proof": proof}))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found[0].reason == "nodes[0]: the proof does not reach this interval"  # after all that needs memory
    assert peak < 20e6


def test_a_power_of_the_rate_is_not_taken_for_ever() -> None:
    found = certificate("rate power")
    for power in (10**6, 10**15):
        found["claims"][0]["proof"]["power"] = power
        found["claims"][0]["rate"] = (1 - 2.0**-53).hex()
        assert check(found)[0].result == "not checked here"


def test_second_moments_are_judged_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """40 rows of numbers spread over 900 binary orders of magnitude, singular, so that every pivot counts."""
    rng = random.Random(1)
    L = [[rng.randrange(1, 2**53) << rng.randrange(0, 900) if j < i else 0 for j in range(40)] for i in range(40)]
    factor = checker.Matrix(L)
    monkeypatch.setattr(checker.Clock, "end", time.process_time() + 60)
    assert checker.is_semidefinite(factor.by(factor))


def test_the_widest_numbers_are_decided_in_time() -> None:
    """Entries from 2^-500 to 2^500 in every text."""
    data = scalar_data(0.5)
    data |= {"n": 2, "A": text([2.0**-500, 2.0**510, 0, 0.5]), "process": {"Q": text([1, 0, 0, 1])}}
    proof = {"method": "full", "X": text([2.0**500, 0, 2.0**-500])}
    claim = stability_claim(scalar_data(0.5), "full") | {"proof": proof, "margin": 0.0}
    assert check(document(data, claim))[0].result == "invalid"
    data["A"] = text([2.0**-500, 0, 0, 0.5])
    assert check(document(data, claim))[0].result == "valid"


def test_memory_stays_near_the_size_of_the_file(tmp_path: Path) -> None:
    """A file of brackets, or of one long text, cannot be blown up: the process lives within 600 MB."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (600 * 2**20, 600 * 2**20))

    for i, content in enumerate(
        (b"[" + b"[]," * 300_000 + b"[]]", PLAIN.replace('"A": "', '"A": "' + " " * 5_000_000).encode())
    ):
        file = tmp_path / f"{i}.json"
        file.write_bytes(content)
        done = subprocess.run(
            [sys.executable, "-I", checker.__file__, file],
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=limit,
            timeout=60,
        )
        assert (done.returncode, done.stdout) == (2, "")
        assert len(done.stderr.splitlines()) == 1


def test_the_source_has_no_means_to_run_what_it_reads() -> None:
    source = Path(checker.__file__).read_text(encoding="utf-8")
    for word in ("eval(", "exec(", " compile(", "pickle", "import_", "importlib", "subprocess", "system", "getattr("):
        assert word not in source
