"""Built-in problems: some that are shipped as files, and networks drawn at random."""

from __future__ import annotations

from importlib import resources
from typing import Literal, overload

from tolnet.model._checks import nearest
from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.errors import InputError
from tolnet.model.examples._field import field, field_50
from tolnet.model.examples._projectile import projectile
from tolnet.model.examples._random import random_network
from tolnet.model.network import SensorNetwork
from tolnet.model.reading import parse_text
from tolnet.model.reading_corrupted import parse_corrupted_text

__all__ = ["example", "example_names", "field", "field_50", "projectile", "random_network"]

RANDOM_NODES = 50
CORRUPTED = ("field", "field-50")
"""Those with corrupted channels."""


def example_names() -> dict[str, str]:
    """The built-in problems by name, and what each is about."""
    return {
        "projectile": "20 sensors track a projectile (37 links, the published study)",
        "ieee14": "the 14 buses of an IEEE test grid estimate its voltage angles",
        "unstable-path": "stable filters on a path that relative-degree weights make unstable",
        "unstable-ring": "stable filters on a ring that uniform weights make unstable",
        "unstable-metropolis": "stable filters on a path that Metropolis weights make unstable",
        "random": "any number of nodes track a target",
        "field": "4 sensors in a field that heats up, over corrupted channels (a surrogate of the published example)",
        "field-50": "the same field with 50 sensors (a surrogate, too)",
    }


@overload
def example(
    name: Literal["projectile", "ieee14", "random"], nodes: int | None = None, seed: int | None = None
) -> SensorNetwork: ...
@overload
def example(name: Literal["field", "field-50"]) -> CorruptedNetwork: ...
@overload
def example(name: str, nodes: int | None = None, seed: int | None = None) -> SensorNetwork | CorruptedNetwork: ...
def example(name: str, nodes: int | None = None, seed: int | None = None) -> SensorNetwork | CorruptedNetwork:
    """A built-in problem. `projectile` takes a seed, which draws another network; `random` takes nodes and seed.

    `field` and `field-50` have corrupted channels; the others are a SensorNetwork.

    Raises InputError for a name that is not built in, with the nearest one, and for an option that it does not take.
    """
    if name not in example_names():
        known = ", ".join(example_names())
        raise InputError(
            f"{name!r} is no built-in problem; did you mean {nearest(name, example_names())!r}? ({known})"
        )
    if name == "random":
        return random_network(RANDOM_NODES if nodes is None else nodes, 0 if seed is None else seed)
    if nodes is not None:
        raise InputError(f"{name!r} has as many nodes as it has; only 'random' takes nodes")
    if seed is None:
        file = resources.files("tolnet.model.examples").joinpath(f"{name}.toml")
        parse = parse_corrupted_text if name in CORRUPTED else parse_text
        return parse(file.read_bytes(), source=f"built-in problem {name}")
    if name == "projectile":
        return projectile(seed)
    raise InputError(f"{name!r} is not drawn at random; it takes no seed")
