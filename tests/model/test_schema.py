"""The JSON Schema that is shipped: current, and of one mind with the reader."""

from __future__ import annotations

import copy
import json
import tomllib
from importlib import resources
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from tests.model.networks import arguments

from tolnet import model
from tolnet.model import SensorNetwork
from tolnet.model.examples import random_network
from tolnet.model.problem import problem_schema

SCHEMA = json.loads(resources.files("tolnet.model").joinpath("problem.schema.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)


def shipped(name: str) -> dict[str, Any]:
    text = resources.files("tolnet.model.examples").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def test_the_shipped_schema_is_current():
    assert problem_schema() == SCHEMA, "run scripts/make_schema.py"
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("name", ["projectile", "ieee14"])
def test_built_in_problems_satisfy_it(name):
    VALIDATOR.validate(shipped(name))


@given(given_arguments=arguments())
def test_saved_problems_satisfy_it(given_arguments, tmp_path_factory):
    folder = tmp_path_factory.mktemp("schema")
    network = SensorNetwork(**given_arguments)
    for arrays in (True, False):
        path = model.save(network, folder / "p.toml", arrays=arrays)[0]
        VALIDATOR.validate(tomllib.loads(path.read_text(encoding="utf-8")))


def test_large_problems_satisfy_it(tmp_path):
    path = model.save(random_network(3000, seed=0), tmp_path / "p.toml")[0]
    VALIDATOR.validate(tomllib.loads(path.read_text(encoding="utf-8")))


EYE = np.eye(6).tolist()
SPOILT = [
    (("schema",), "tolnet.problem/2"),
    (("plnt",), {}),
    (("plant", "G"), EYE),
    (("plant", "A"), "eye"),
    (("plant", "A", 0, 0), "1"),
    (("plant", "A", 0, 0), True),
    (("plant", "A"), {"array": 1}),
    (("plant", "Q"), EYE),
    (("plant", "dt"), 0),
    (("network", "nodes"), 0),
    (("network", "nodes"), 2.5),
    (("network", "edges", 0), [1, 2, 3]),
    (("network", "edges", 0), [1, -1]),
    (("network", "graphml"), "x.graphml"),
    (("network", "directed"), "no"),
    (("sensors", 0, "D"), np.eye(3).tolist()),
    (("sensors", 0), {"C": [[1.0]]}),
    (("sensors", 0), {"R": [[1.0]]}),
    (("ambiguity", "tolerance"), -1),
    (("ambiguity", "convention"), "bits"),
    (("ambiguity", "tau"), 1.5),
    (("ambiguity",), {"convention": "gamma"}),
    (("diffusion", "rule"), "metropolys"),
    (("diffusion", "weights"), EYE),
]


@pytest.mark.parametrize(("place", "value"), SPOILT, ids=map(str, range(len(SPOILT))))
def test_what_the_reader_refuses_for_its_form_the_schema_refuses(place, value):
    problem = copy.deepcopy(shipped("projectile"))
    table: Any = problem
    for step in place[:-1]:
        table = table[step]
    table[place[-1]] = value
    with pytest.raises(model.InputError):
        model.parse(problem)
    assert not VALIDATOR.is_valid(problem)


@pytest.mark.parametrize("key", ["schema", "plant", "network", "sensors"])
def test_what_is_needed(key):
    problem = shipped("projectile")
    del problem[key]
    assert not VALIDATOR.is_valid(problem)
