"""Problem files of networks with corrupted channels: written, read, refused, and kept apart from the others."""

from __future__ import annotations

import copy
import json
import random
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from tests.instances_corrupted import drawn
from tests.model.networks import assert_same_sparse

from tolnet import model
from tolnet.model import CorruptedNetwork, InputError, SensorNetwork, SimulationModel
from tolnet.model.examples import field, field_50

SCHEMA = json.loads(resources.files("tolnet.model").joinpath("problem.schema.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

GOOD = """
schema = "tolnet.problem/1"
name = "two"

[plant]
A = [[0.9, 0.1], [0.0, 0.8]]
Q = [[1.0, 0.0], [0.0, 1.0]]
F = [[0.1, 0.0], [0.0, 0.1]]
multiplicative_variance = 0.01
initial_second_moment = [[1.0, 0.0], [0.0, 1.0]]

[network]
nodes = 2
edges = [[0, 1]]

[[sensors]]
C = [[1.0, 0.0]]
R = [[0.5]]
fading_mean = 0.9
fading_variance = 0.003
interval = 2

[[sensors]]
C = [[0.0, 1.0], [1.0, 1.0]]
R = [[0.5, 0.1], [0.1, 0.5]]
initial_covariance = [[2.0, 0.0], [0.0, 2.0]]

[channel]
estimate_noise = 0.0033
matrix_noise = [[0.4, 0.1], [0.1, 0.4]]
links = [{ from = 0, to = 1, estimate_noise = 0.01 }]

[fusion]
weights = [[0.5, 0.5], [0.25, 0.75]]
window = 3
interval = 4

[simulation]
fading = "bernoulli"
channel = { kind = "uniform", half_width = 0.1 }
"""


def assert_same(one: CorruptedNetwork, other: CorruptedNetwork) -> None:
    """Two networks agree to the last bit; only their digests may differ."""
    for letter, part in one.varying.items():
        same = other.varying[letter].one_period
        T = max(len(part.one_period), len(same))
        for k in range(T):  # what repeats within its period may come back with a shorter one
            assert part(k).tobytes() == other.varying[letter](k).tobytes(), letter
    for key in ("initial_mean", "initial_covariance", "initial_second_moment", "rows", "interval"):
        assert getattr(one, key).tobytes() == getattr(other, key).tobytes(), key
    for key in ("window", "simulation", "states", "dt", "names", "name", "description", "directed"):
        assert getattr(one, key) == getattr(other, key), key
    assert_same_sparse(one.adjacency, other.adjacency)
    assert_same_sparse(one.fusion, other.fusion)


@pytest.mark.parametrize("arrays", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_what_is_saved_is_read(seed: int, arrays: bool, tmp_path: Path):
    generator = np.random.default_rng(seed)
    network = drawn(seed)
    network = drawn(
        seed,
        interval=generator.integers(1, 4, network.N),
        window=3,
        simulation=SimulationModel(fading="bernoulli", half_width=0.25),
        names=[f"node {i}" for i in range(network.N)],
        initial_mean=generator.standard_normal(network.n),
    )
    path = model.save(network, tmp_path / "p.toml", arrays=arrays)[0]
    assert_same(network, model.load_corrupted(path))
    VALIDATOR.validate(tomllib.loads(path.read_text(encoding="utf-8")))
    assert isinstance(model.load_problem(path), CorruptedNetwork)
    assert model.validate(path) == []


def test_sensors_of_one_size_are_stacks_in_an_archive(tmp_path: Path):
    path, side = model.save(field_50(), tmp_path / "p.toml", arrays=True)
    with np.load(side) as archive:
        assert archive["C"].shape == (50, 1, 4)
        assert archive["fading_mean"].shape == (50,)
    assert_same(field_50(), model.load_corrupted(path))


def test_the_contract_by_hand():
    network = model.parse_corrupted(tomllib.loads(GOOD))
    VALIDATOR.validate(tomllib.loads(GOOD))
    assert network.mu(0) == 0.01
    np.testing.assert_array_equal(network.tau(0), [0.9, 1.0])
    np.testing.assert_array_equal(network.phi(0), [0.003, 0.0])
    np.testing.assert_array_equal(network.interval, [2, 4])
    np.testing.assert_array_equal(network.initial_covariance, [np.eye(2), 2 * np.eye(2)])
    np.testing.assert_array_equal(network.pairs, [[0, 0], [0, 1], [1, 0], [1, 1]])
    assert [bound[0, 0] for bound in network.W_bar(0)] == [0.0, 0.0033, 0.01, 0.0]
    np.testing.assert_array_equal(network.D_bar(0)[1], [[0.4, 0.1], [0.1, 0.4]])
    np.testing.assert_array_equal(network.fusion.toarray(), [[0.5, 0.5], [0.25, 0.75]])
    assert network.window == 3
    assert network.simulation == SimulationModel("bernoulli", "uniform", 0.1)


def test_periods_in_a_file():
    text = GOOD.replace("fading_mean = 0.9", "fading_mean = [0.9, 0.8]")
    text = text.replace("A = [[0.9, 0.1], [0.0, 0.8]]", "A = [[[0.9, 0.1], [0.0, 0.8]], [[1.0, 0.0], [0.0, 1.0]]]")
    text = text.replace("estimate_noise = 0.0033", "estimate_noise = [0.1, 0.2, 0.3]")
    VALIDATOR.validate(tomllib.loads(text))
    network = model.parse_corrupted(tomllib.loads(text))
    assert network.period == 6
    assert network.W_bar(4)[1, 0, 0] == 0.2
    assert network.tau(3)[0] == 0.8
    with pytest.raises(InputError, match=r"plant.A is 2 x 2 x 2; an n x n matrix was expected"):
        model.parse(tomllib.loads(text))


def test_one_file_for_both_methods(tmp_path: Path):
    path = tmp_path / "both.toml"
    path.write_text(GOOD + '\n[ambiguity]\ntolerance = 0.02\n[diffusion]\nrule = "uniform"\n')
    exact, corrupted = model.load(path), model.load_corrupted(path)
    assert exact.ambiguity == model.Ambiguity(0.02)
    np.testing.assert_array_equal(exact.A, corrupted.A(0))
    assert exact.digest == corrupted.digest
    assert isinstance(model.load_problem(path), CorruptedNetwork)


def test_a_file_without_channels_stays_what_it_is(tmp_path: Path):
    path = model.save(model.example("projectile"), tmp_path / "p.toml")[0]
    shipped = resources.files("tolnet.model.examples").joinpath("projectile.toml").read_bytes()
    assert path.read_bytes() == shipped
    assert isinstance(model.load_problem(path), SensorNetwork)
    assert_same(model.load_corrupted(path), CorruptedNetwork.of(model.load(path)))


BAD: dict[str, tuple[str, str, str]] = {
    "rows": ("[[0.5, 0.5],", "[[0.5, 0.4],", "fusion.weights[0]"),
    "tau": ("fading_mean = 0.9", "fading_mean = 1.5", "sensors[0].fading_mean"),
    "tau zero": ("fading_mean = 0.9", "fading_mean = 0.0", "sensors[0].fading_mean"),
    "phi": ("fading_variance = 0.003", "fading_variance = -0.003", "sensors[0].fading_variance"),
    "mu": ("multiplicative_variance = 0.01", "multiplicative_variance = -0.01", "plant.multiplicative_variance"),
    "A": ("A = [[0.9, 0.1]", "A = [[0.0, 0.0]", "plant.A"),
    "Q": ("Q = [[1.0, 0.0], [0.0, 1.0]]", "Q = [[1.0, 0.0], [0.0, 0.0]]", "plant.Q"),
    "W": ("estimate_noise = 0.0033", "estimate_noise = -0.0033", "channel.estimate_noise"),
    "D": ("[[0.4, 0.1], [0.1, 0.4]]", "[[0.4, 0.9], [0.9, 0.4]]", "channel.matrix_noise"),
    "link": ("{ from = 0, to = 1,", "{ from = 0, to = 7,", "channel.links[0]"),
    "graph": ("edges = [[0, 1]]", "directed = true\nedges = [[0, 1]]", "network.edges"),
    "window": ("window = 3", "window = 0", "fusion.window"),
    "interval": ("interval = 4", "interval = 0", "fusion.interval"),
    "input": ("[network]", "input = [1.0, 0.0]\n[network]", "plant.input"),
    "key": ("window = 3", "windows = 3", "fusion.windows"),
    "rule beside weights": ("window = 3", 'rule = "uniform"', "fusion"),
    "law": ('"bernoulli"', '"gauss"', "simulation.fading"),
    "half width": ("half_width = 0.1", "half_width = -0.1", "simulation.channel.half_width"),
}


@pytest.mark.parametrize("fault", BAD)
def test_each_fault_is_told_once_with_its_key(fault: str, tmp_path: Path):
    right, wrong, key = BAD[fault]
    assert right in GOOD
    path = tmp_path / "wrong.toml"
    text = GOOD.replace(right, wrong, 1)
    if fault == "graph":
        text = text.replace("links = [{ from = 0, to = 1, estimate_noise = 0.01 }]", "").replace(
            "weights = [[0.5, 0.5], [0.25, 0.75]]", ""
        )
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        model.load_problem(path)
    assert [each.key for each in caught.value.complaints] == [key]
    assert model.validate(path) == list(caught.value.complaints)


SPOILT: list[tuple[tuple[Any, ...], Any]] = [
    (("plant", "F"), "eye"),
    (("plant", "A"), [[[1.0]], []]),
    (("plant", "multiplicative_variance"), -1.0),
    (("plant", "multiplicative_variance"), []),
    (("sensors", 0, "fading_mean"), 0.0),
    (("sensors", 0, "fading_mean"), [0.5, 1.5]),
    (("sensors", 0, "fading_variance"), "none"),
    (("sensors", 0, "interval"), 1.5),
    (("channel", "estimate_noise"), -1.0),
    (("channel", "links"), [{"from": 0, "matrix_noise": 1.0}]),
    (("channel", "links"), [{"from": 0, "to": 1}]),
    (("channel", "noise"), 1.0),
    (("fusion", "rule"), "metropolys"),
    (("fusion", "rule"), "uniform"),
    (("fusion", "window"), 0),
    (("simulation", "fading"), "gauss"),
    (("simulation", "channel"), {"width": 1.0}),
    (("simulation", "noise"), "uniform"),
]


@pytest.mark.parametrize(("place", "value"), SPOILT, ids=map(str, range(len(SPOILT))))
def test_what_the_reader_refuses_for_its_form_the_schema_refuses(place: tuple[Any, ...], value: Any):
    problem = tomllib.loads(GOOD)
    table: Any = problem
    for step in place[:-1]:
        table = table[step]
    table[place[-1]] = value
    with pytest.raises(InputError):
        model.parse_corrupted(problem)
    assert not VALIDATOR.is_valid(problem)


def test_functions_cannot_be_saved(tmp_path: Path):
    network = field().replaced(multiplicative_variance=lambda k: 1.0)
    with pytest.raises(InputError, match=r"plant\.multiplicative_variance is a function of k, which a file"):
        model.save(network, tmp_path / "p.toml")
    assert list(tmp_path.iterdir()) == []


def test_the_built_in_problems_are_those_of_their_scripts(tmp_path: Path):
    for network, name in ((field(), "field"), (field_50(), "field-50")):
        shipped = resources.files("tolnet.model.examples").joinpath(f"{name}.toml")
        assert model.save(network, tmp_path / "p.toml", arrays=False)[0].read_bytes() == shipped.read_bytes()
        assert_same(network, model.example(name))  # pyright: ignore[reportArgumentType]
        assert "surrogate" in network.description
        VALIDATOR.validate(tomllib.loads(shipped.read_text(encoding="utf-8")))
    large = field_50()
    np.testing.assert_allclose(large.fusion.sum(axis=1), 1)
    kinds = {tuple(row) for row in large.C(0)}
    assert len(kinds) == 4
    assert large.adjacency.nnz == (large.adjacency.T).nnz


ODD: list[Any] = [
    None, 0, -1, 1.5, 1e308, float("nan"), float("inf"), "x", True, 10**400, [], [[]], [[[]]], [[[1.0]]], [1.0, 2.0],
    [[1.0, 2.0]], {}, {"array": "x"}, [[1.0, 0.0], [0.0, 1.0]], [[[1.0, 0.0], [0.0, 1.0]]], [None], [{}], {"from": 0},
    [[1.0], [1.0, 2.0]], [[[1.0, 0.0], [0.0, 1.0]], [[1.0]]],
]  # fmt: skip


def places(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every key path of a file."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place, *(deeper for key, item in items for deeper in places(item, (*place, key)))]


@pytest.mark.filterwarnings("ignore::tolnet.model.LooseBoundWarning")
@pytest.mark.parametrize("seed", range(4))
def test_whatever_stands_in_a_file_is_read_or_refused(seed: int):
    generator = random.Random(seed)
    everywhere = places(tomllib.loads(GOOD))[1:]
    refused, accepted = 0, 0
    for _ in range(150):
        problem: Any = tomllib.loads(GOOD)
        for _ in range(generator.choice([1, 1, 2, 3])):
            *way, last = generator.choice(everywhere)
            table = problem
            try:
                for step in way:
                    table = table[step]
                table[last] = copy.deepcopy(generator.choice(ODD))
            except (KeyError, IndexError, TypeError):
                continue  # an earlier change took the place away
        try:
            model.parse_corrupted(problem)
        except InputError as error:
            refused += bool(error.complaints)
        else:
            accepted += 1
    assert refused + accepted == 150
    assert refused > 100
