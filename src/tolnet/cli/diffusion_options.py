"""What the options of `tolnet diffusion` ask for, refused in their own words where nothing can satisfy it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tolnet.cli.console import Console

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from tolnet.design import Constraints
    from tolnet.model import Ambiguity, Complaint, SensorNetwork, ToleranceTable


def constraints_of(
    network: SensorNetwork, ambiguity: Ambiguity, own_weight: float, max_neighbours: int | None, symmetric: bool
) -> Constraints:
    """What is asked of W, in the words of the command line where nothing can satisfy it."""
    from tolnet.design import Constraints
    from tolnet.model import InputError, UnsupportedError

    if ambiguity.tau != 0:
        raise UnsupportedError(
            f"the least favourable model is defined for tau = 0 only, and ambiguity.tau is {ambiguity.tau:g}"
        )
    constraints = Constraints(symmetric=symmetric, own_weight=own_weight, max_neighbours=max_neighbours)
    try:
        constraints.check(network)
    except InputError as error:
        raise InputError(_as_options(error.complaints)) from None
    return constraints


def check_combination(objective: str, constraints: Constraints, with_gains: bool, method: str) -> None:
    """Raise for options that cannot be had together, before anything is computed."""
    from tolnet.design.weights.optimise import complaints_of
    from tolnet.model import InputError

    complaints = complaints_of(objective, constraints, with_gains, method)
    if complaints:
        raise InputError(_as_options(complaints))


def _as_options(complaints: Sequence[Complaint]) -> list[Complaint]:
    """The same in the words of the command line."""
    return [replace(c, key=f"--{c.key.replace('_', '-')}") for c in complaints]


def chosen_nodes(network: SensorNetwork, nodes: str | None, objective: str) -> np.ndarray | None:
    """Weights of the nodes that were named; None for all alike."""
    import numpy as np

    from tolnet.model import InputError

    if nodes is None:
        return None
    if objective != "msd":
        raise InputError(f"--nodes is given; the objective {objective!r} weighs no nodes")
    a = np.zeros(network.N)
    for word in nodes.split(","):
        a[_node(network, word.strip(), "--nodes")] = 1.0
    return a


def _node(network: SensorNetwork, word: str, option: str) -> int:
    from tolnet.model import InputError

    labels = [network.label(k) for k in range(network.N)]
    if word in labels:
        return labels.index(word)
    if word.isdigit() and int(word) < network.N:
        return int(word)
    known = f"names or indices up to {network.N - 1}" if network.names else f"indices from 0 to {network.N - 1}"
    raise InputError(f"{option} names {word!r}, which is no node; {known} were expected")


def check_scenarios(
    network: SensorNetwork, objective: str, tolerances: list[float] | None, lost: list[str] | None
) -> None:
    from tolnet.model import InputError

    for option, given in (("--scenario-tolerance", tolerances), ("--without-link", lost)):
        if given and objective != "robust":
            raise InputError(f"{option} is given; the objective {objective!r} has one scenario")
    for pair in lost or ():
        _link(network, pair)


def _link(network: SensorNetwork, pair: str) -> tuple[int, int]:
    """The two ends of a link, given as A-B."""
    from tolnet.model import InputError

    for at in (i for i, letter in enumerate(pair) if letter == "-"):
        try:
            l, k = (_node(network, word, "--without-link") for word in (pair[:at], pair[at + 1 :]))
        except InputError:
            continue
        if l != k and (network.adjacency[l, k] or network.adjacency[k, l]):
            return l, k
        raise InputError(f"--without-link names {pair!r}, and there is no such link")
    raise InputError(f"--without-link is {pair!r}; two nodes with a dash between them were expected")


def check_added(network: SensorNetwork, m: int, objective: str, constraints: Constraints, more: bool) -> None:
    from tolnet.model import InputError

    if objective != "msd":
        raise InputError(f"--add-links ranks links by the MSD of the network; the objective is {objective!r}")
    if more or constraints.symmetric or constraints.own_weight or constraints.max_neighbours is not None:
        raise InputError(
            "--add-links ranks links by what weights without constraints make of the whole network; it cannot be"
            " combined with --with-gains, --nodes, --symmetric, --own-weight or --max-neighbours"
        )
    lacking = network.N * (network.N - 1) // (1 if network.directed else 2) - len(network.links)
    if not 1 <= m <= lacking:
        raise InputError(f"--add-links is {m}; the graph lacks {lacking} links")


def scenario_tables(
    network: SensorNetwork,
    table: ToleranceTable,
    ambiguity: Ambiguity,
    tolerances: list[float] | None,
    lost: list[str] | None,
    console: Console,
) -> Sequence[ToleranceTable]:
    """The table itself, then those at other tolerances and on networks that lost a link."""
    import numpy as np

    from tolnet import analysis, design
    from tolnet.model import Ambiguity

    c = ambiguity.tolerance
    wanted = [c / 2, 2 * c] if tolerances is None and not lost else tolerances or []
    with console.progress("scenarios"):
        tables = [table]
        for other in wanted:
            one = design.choose_tolerances(network, Ambiguity(other, ambiguity.convention))
            if tolerances is None and not analysis.least_favourable_model(network, one.central).exists:
                console.note(f"no scenario at c = {other:g}: the centre has no least favourable model there")
                continue
            tables.append(one)
        for pair in lost or ():
            ends = set(_link(network, pair))
            kept = [link for link in network.links.tolist() if set(link) != ends]
            shorter = network.relinked(np.array(kept, dtype=np.int64).reshape(-1, 2))
            tables.append(design.choose_tolerances(shorter, ambiguity))
    return tables
