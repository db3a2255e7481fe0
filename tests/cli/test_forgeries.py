"""Designed forgeries: each is refused, with the reason; the certificates that they are made of are accepted."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import pytest
from tests.certificates.forgeries import Forgery, Kit, forgeries, networks, written
from tests.cli.conftest import Tolnet

STRIDE = 1 if os.environ.get("TOLNET_STUDY") == "full" else 11


@cache
def kit(name: str) -> Kit:
    """One for all tests: its true certificate is made once."""
    return Kit(networks()[name])


NAMES = [(network, name) for network in networks() for name, _ in forgeries(Kit(networks()[network]))]


def test_there_are_two_hundred_of_them():
    assert len(NAMES) == len(set(NAMES)) > 200


@pytest.mark.parametrize("network", networks())
def test_what_forgeries_are_made_of_is_true(tolnet: Tolnet, tmp_path: Path, network: str):
    honest = Forgery(kit(network).copy(), "")
    ran = tolnet(*written(honest, kit(network), tmp_path))
    assert ran.code == 0, ran.err
    ran = tolnet(*written(honest, kit(network), tmp_path), "--require", "schur-stability,steady-state,tolerance")
    assert ran.code == 0, ran.err


@pytest.mark.parametrize(("network", "name"), NAMES[::STRIDE])
def test_a_forgery_is_refused(tolnet: Tolnet, tmp_path: Path, network: str, name: str):
    made = dict(forgeries(kit(network)))[name]()
    ran = tolnet(*written(made, kit(network), tmp_path))
    assert ran.code in made.codes, ran.out
    assert made.word in ran.out + ran.err
