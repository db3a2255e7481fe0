"""How values are judged and quoted; and arguments of the wrong type, without the run-time types of these tests."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from tolnet.model._checks import Complaints, nearest, number, shown


@pytest.mark.parametrize(
    ("value", "quoted"),
    [
        (True, "true"),
        (np.False_, "false"),
        (3, "3"),
        (np.int64(3), "3"),
        (np.float64(0.1), "0.1"),
        (10**30, "an integer of about 31 digits"),
        (-(10**6000), "an integer of about 6001 digits"),
        ("a\nb", r"'a\nb'"),
        ("x" * 99, f"'{'x' * 57}'..."),
        ([1, 2], "a list of 2"),
        ({}, "a table"),
        (None, "nothing"),
        (object(), "of type object"),
    ],
    ids=range(13),
)
def test_values_are_quoted_short(value, quoted):
    assert shown(value) == quoted


@pytest.mark.parametrize(
    "value", [True, "1", None, [1.0], 1j, np.ones(1), float("nan"), -np.inf, 10**400, np.bool_(1)]
)
def test_what_is_no_number(value):
    complaints = Complaints()
    assert number(value, "key", "a number", complaints) is None
    assert [str(c) for c in complaints.found] == [f"key is {shown(value)}; a number was expected"]


@pytest.mark.parametrize("value", [1, 1.0, np.int8(1), np.float32(1.0), np.float64(1.0)])
def test_what_is_a_number(value):
    result = number(value, "key", "a number", Complaints())
    assert type(result) is float
    assert result == 1.0


def test_the_nearest_word_takes_no_notice_of_case():
    assert nearest("a", ["input", "A", "states"]) == "A"
    assert nearest("initialcovariance", ["initial_mean", "initial_covariance"]) == "initial_covariance"
    assert nearest("zzz", ["x"]) == "x"


WRONG_TYPES = """
import warnings; warnings.simplefilter("error")
from tolnet.model import Ambiguity, InputError, SensorNetwork
good = dict(A=[[0.5]], B=[[1.0]], C=[[[1.0]]], R=[[[1.0]]], edges=[])
SensorNetwork(**good, dt=1, ambiguity=Ambiguity(1, tau=1))
for make, message in [
    (lambda: Ambiguity("0.1"), "ambiguity.tolerance is '0.1'; a finite number >= 0 was expected"),
    (lambda: Ambiguity(True), "ambiguity.tolerance is true; a finite number >= 0 was expected"),
    (lambda: Ambiguity(0.1, ["nats"]), "ambiguity.convention is a list of 1; 'gamma' or 'nats' was expected"),
    (lambda: Ambiguity(0.1, tau="x"), "ambiguity.tau is 'x'; a number from 0 to 1 was expected"),
    (lambda: SensorNetwork(**good, directed="no"), "network.directed is 'no'; true or false was expected"),
    (lambda: SensorNetwork(**good, ambiguity=0.1), "ambiguity is 0.1; an Ambiguity was expected"),
    (lambda: SensorNetwork(**good, dt="1"), "plant.dt is '1'; a positive number of seconds was expected"),
    (lambda: SensorNetwork(**good, states=[1]), "plant.states is not a list of texts"),
    (lambda: SensorNetwork(**good, name=3), "name is 3; text without control characters was expected"),
    (lambda: SensorNetwork(**good, diffusion=3), "diffusion.weights is not an N x N matrix of numbers"),
]:
    try:
        make()
    except InputError as error:
        assert str(error) == message, (str(error), message)
    else:
        raise AssertionError(message)
"""


def test_arguments_of_the_wrong_type_are_complained_about():
    done = subprocess.run([sys.executable, "-c", WRONG_TYPES], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
