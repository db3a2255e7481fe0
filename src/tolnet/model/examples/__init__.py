"""Built-in problems: some that are shipped as files, and networks drawn at random."""

from __future__ import annotations

from importlib import resources

from tolnet.model._checks import nearest
from tolnet.model.errors import InputError
from tolnet.model.examples._projectile import projectile
from tolnet.model.examples._random import random_network
from tolnet.model.network import SensorNetwork
from tolnet.model.reading import parse_text

__all__ = ["example", "example_names", "projectile", "random_network"]

RANDOM_NODES = 50


def example_names() -> dict[str, str]:
    """The built-in problems by name, and what each is about."""
    return {
        "projectile": "20 sensors track a projectile (37 links, the published study)",
        "ieee14": "the 14 buses of an IEEE test grid estimate its voltage angles",
        "unstable-path": "stable filters on a path that relative-degree weights make unstable",
        "unstable-ring": "stable filters on a ring that uniform weights make unstable",
        "unstable-metropolis": "stable filters on a path that Metropolis weights make unstable",
        "random": "any number of nodes track a target",
    }


def example(name: str, nodes: int | None = None, seed: int | None = None) -> SensorNetwork:
    """A built-in problem. `projectile` takes a seed, which draws another network; `random` takes nodes and seed.

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
        return parse_text(file.read_bytes(), source=f"built-in problem {name}")
    if name == "projectile":
        return projectile(seed)
    raise InputError(f"{name!r} is not drawn at random; it takes no seed")
