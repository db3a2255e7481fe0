"""`tolnet validate`: every complaint at once, or what is in the file."""

from __future__ import annotations

import json
from pathlib import Path

from tests.cli.conftest import Tolnet
from tests.cli.test_refusals import GOOD


def test_every_complaint_comes_at_once_a_line_each(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "wrong.toml"
    wrong = GOOD.replace("R = [[0.5]]", "R = [[-0.5]]").replace("[[0, 1]]", "[[0, 9]]")
    path.write_text(wrong.replace("tolerance = 0.02", "tolerance = -1.0"))
    ran = tolnet("validate", path)
    assert ran.code == 2
    lines = ran.err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"error: {path}: ") for line in lines)
    for key in ("sensors[0].R", "network.edges[0]", "ambiguity.tolerance"):
        assert sum(key in line for line in lines) == 1


def test_complaints_are_a_document_too(tolnet: Tolnet, tmp_path: Path):
    path = tmp_path / "wrong.toml"
    path.write_text(GOOD.replace("[[0, 1]]", "[[0, 9]]"))
    ran = tolnet("validate", path, "--json", "-o", tmp_path / "report.json")
    assert ran.code == 2
    document = ran.document
    assert (document["schema"], document["status"]) == ("tolnet.validation/1", "invalid")
    assert [complaint["key"] for complaint in document["complaints"]] == ["network.edges[0]"]
    assert json.loads((tmp_path / "report.json").read_text()) == document


def test_a_right_file_says_what_is_in_it(tolnet: Tolnet, ring: Path):
    ran = tolnet("validate", ring)
    assert ran.code == 0
    text = " ".join(ran.out.split())
    for fact in (
        "n = 6 states, every 0.1 s",
        "N = 20 nodes, 40 links; each hears 5, itself included, mean 5",
        "3 outputs a node, 60 in all; 0 relays",
        "diffusion relative-degree",
        "c = 0.02 (gamma)",
        f"tolnet table {ring}",
    ):
        assert fact in text
    document = tolnet("validate", ring, "--json").document
    assert (document["status"], document["complaints"]) == ("ok", [])
    assert (document["nodes"], document["links"], document["states"]) == (20, 40, 6)
    assert document["degree"] == {"least": 5, "mean": 5.0, "most": 5}


def test_a_built_in_problem_is_right(tolnet: Tolnet):
    assert tolnet("validate", "ieee14").code == 0
