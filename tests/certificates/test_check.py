"""The stand-alone checker accepts what is proved: every method, as a library and as a process."""

from __future__ import annotations

import json
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest
from tests.certificates.examples import certificate, certificates
from tests.reference import certificates as maker
from tests.reference.certificate_truth import is_true

from tolnet.certificates import check as checker
from tolnet.certificates.check import check, exit_code, load


@pytest.mark.parametrize("name", certificates())
def test_what_is_proved_is_valid(name: str) -> None:
    document = certificate(name)
    findings = check(document)
    assert [(finding.result, finding.reason) for finding in findings] == [("valid", None)]
    assert all(is_true(document["data"], claim) for claim in document["claims"])
    assert document == certificate(name)  # nothing was changed on the way


@pytest.mark.parametrize("name", certificates())
def test_the_smallest_change_of_the_data_that_matters_is_noticed(name: str) -> None:
    """Ten times the gains (or, of a relay, the weights) is another network."""
    document = certificate(name)
    data = document["data"]
    for texts in (data["weights"], data["gains"]):
        texts[:] = [" ".join((10 * float.fromhex(x)).hex() for x in words.split()) for words in texts]
    for claim, finding in zip(document["claims"], check(document), strict=True):
        assert finding.result == "invalid" or is_true(data, claim)


def test_an_eigenpair_is_left_to_others() -> None:
    document = certificate("lyapunov")
    document["claims"] = [maker.instability_claim(document["data"], "eigenpair", block="F")]
    finding = check(document)[0]
    assert finding.result == "not checked here"
    assert finding.reason is not None
    assert "tolnet check" in finding.reason


def test_zeros_at_the_end_of_a_fraction_may_be_left_out_but_nothing_is_rounded() -> None:
    document = certificate("primal network")
    data = document["data"]
    data["C"] = [words.replace("0x1.0000000000000p", "0x1p") for words in data["C"]]
    short = {"A": "0x1.8p-1 0x0p+0 0x0.0p+0 0x1p-2", "B": "0x1.8p-1 0x0p+0 0x0p+0 0x1p-2"}
    data["A"] = short["B"]
    assert check(document)[0].result in ("valid", "invalid")
    for wrong in (short["A"], "0x1.80p-1 0x0p+0 0x0p+0 0x1p-2", "0x1.fffffffffffffp-1070 0x0p+0 0x0p+0 0x1p-2"):
        data["A"] = wrong
        with pytest.raises(checker.Refused, match=r"data\.A"):
            check(document)


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-I", checker.__file__, *map(str, arguments)], capture_output=True, text=True, check=False
    )


def test_it_runs_as_a_plain_file(tmp_path: Path) -> None:
    file = tmp_path / "certificate.json"
    document = certificate("primal network")
    file.write_text(json.dumps(document))
    done = run(file)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("valid: schur-stability, proved: With the stated weights and constant gains, every")
    report = json.loads(run(file, "--json").stdout)
    assert report["schema"] == "tolnet.check/1"
    assert [finding["result"] for finding in report["findings"]] == ["valid"]

    document["claims"][0]["margin"] = 0.999
    file.write_text(json.dumps(document))
    done = run(file)
    assert done.returncode == 1
    assert done.stdout.startswith("invalid: schur-stability, proved: the primal condition of node ")
    assert run(tmp_path / "absent.json").returncode == 2


def test_it_imports_the_standard_library_only(tmp_path: Path) -> None:
    program = f"import sys, runpy; runpy.run_path({checker.__file__!r}); print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-I", "-S", "-c", program], capture_output=True, text=True, check=True)
    roots = {name.split(".")[0] for name in done.stdout.split()}
    assert roots - set(sys.stdlib_module_names) <= {"__main__"}


def test_claims_with_a_logarithm_are_not_checked_and_never_valid() -> None:
    document = certificate("primal F")
    document["claims"].append(
        {
            "claim": "tolerance",
            "node": 1,
            "verdict": "proved",
            "statement": "Nobody reads this.",
            "margin": None,
            "reason": None,
            "c": (0.02).hex(),
            "interval": "0x1.0p-4 0x1.0p-3",
            "proof": {"box": {}},
        }
    )
    findings = check(document)
    assert [finding.result for finding in findings] == ["valid", "not checked here"]
    assert exit_code(findings) == 3


def test_an_undecided_claim_claims_nothing() -> None:
    document = certificate("primal F")
    tried = {"claim": "performance", "verdict": "undecided", "statement": "Not shown.", "margin": None}
    document["claims"].append({**tried, "reason": "the residual is too large"})
    findings = check(document)
    assert [finding.result for finding in findings] == ["valid", "undecided"]
    assert exit_code(findings) == 3
    document["claims"][1] |= {"proof": {}, "reason": [["nobody reads this"]], "margin": 0.5}
    assert [finding.result for finding in check(document)] == ["valid", "undecided"]


def test_the_exit_code_is_that_of_the_worst() -> None:
    def codes(*results: str) -> int:
        return exit_code([checker.Finding("", None, "", result, "", None) for result in results])

    assert codes("valid", "valid") == 0
    assert codes("valid", "undecided") == codes("not checked here") == 3
    assert codes("valid", "not checked here", "invalid") == 1


def test_load_returns_what_was_written(tmp_path: Path) -> None:
    file = tmp_path / "certificate.json"
    document = certificate("performance")
    file.write_text(json.dumps(document))
    assert load(str(file)) == document


@pytest.mark.parametrize("exponent", [-3, -1, 0, 1, 5])
def test_numbers_of_every_exponent_are_those_that_they_are(exponent: int) -> None:
    matrix = checker.Matrix([[3, 1], [1, 5]], exponent)
    assert checker._trace(matrix, range(2)) == 8 * Fraction(2) ** exponent
    assert checker._trace(matrix, range(1, 2)) == 5 * Fraction(2) ** exponent
    assert (matrix + matrix).rows == [[6, 2], [2, 10]]
    assert (Fraction(3, 4) * matrix - 1 * matrix).exponent == exponent - 2
    with pytest.raises(ArithmeticError):
        _ = Fraction(1, 3) * matrix


@pytest.mark.parametrize("size", [2, 12, 13, 20, 40])
@pytest.mark.parametrize(
    ("corner", "definite"),
    [
        ([[1, 1], [1, 1]], False),
        ([[1, 1], [1, 2]], True),
        ([[2, -2], [-2, 2]], False),
        ([[0, 0], [0, 1]], False),
        ([[-1, 0], [0, 1]], False),
        ([[1, 2], [2, 1]], False),
        ([[1 << 200, (1 << 200) - 1], [(1 << 200) - 1, 1 << 200]], True),
        ([[1 << 200, 1 << 200], [1 << 200, 1 << 200]], False),
    ],
)
def test_definiteness_on_the_edge(size: int, corner: list[list[int]], definite: bool) -> None:
    rows = [[int(i == j) for j in range(size)] for i in range(size)]
    for shift in (0, size - 2):
        S = [list(row) for row in rows]
        for i in (0, 1):
            S[shift + i][shift : shift + 2] = corner[i]
        assert checker.is_positive_definite(checker.Matrix(S, 0)) is definite
