"""Whether a certificate speaks of one deployment: its numbers and tolerances against those of a problem and a table.

    1.  the numbers of `data` are those of the problem, and of the table where there is one, bit for bit
    2.  the tolerance of the network is one: that of the problem, of the table, and of every claim
    3.  each node's c is the one that its valid `tolerance` claim encloses, within ALIKE
    4.  the gains are those of the steady states of valid `steady-state` claims, within ALIKE (ALIKE_SINGLE)
    5.  the stated least favourable model follows from the centre's steady state in the box of such a claim

What no valid claim ties to the problem is not compared, and never valid. docs/certificate.md, `Comparisons`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tolnet.cli.console import Console
from tolnet.cli.findings import Row, compared_row, named, not_compared, valid
from tolnet.cli.options import choose_ambiguity, open_corrupted, open_problem

if TYPE_CHECKING:
    from tolnet.certificates.deployed import Deployed
    from tolnet.design.export.deployed import DeployedTable
    from tolnet.model import Ambiguity, CorruptedNetwork, SensorNetwork

ALIKE = 1e-9
"""Relative difference up to which tolerances, gains and a model that come from doubles count as the exact ones."""
ALIKE_SINGLE = 1e-6
"""The same of gains that were rounded to single precision, by 2^-24 each."""


@dataclass(frozen=True, eq=False)
class Against:
    """What a certificate is compared with."""

    problem: str
    network: SensorNetwork | CorruptedNetwork
    ambiguity: Ambiguity | None
    """The problem's own, or what the command line says in its place; None where neither says anything."""
    table: Path | None
    stored: DeployedTable | None
    diffusion: str | None
    precision: str

    @classmethod
    def opened(
        cls,
        problem: str,
        table: Path | None,
        tolerance: tuple[float | None, Literal["gamma", "nats"] | None],
        diffusion: str | None,
        precision: str,
        document: Any,
        console: Console,
    ) -> Against:
        """Read the problem and the table. Raises InputError where they are not good, or options contradict them."""
        from tolnet.design.export.deployed import read_deployed
        from tolnet.model import InputError

        if "kind" in document["data"]:
            if table is not None:
                raise InputError("--table is a table for exact channels; the certificate speaks of corrupted ones")
            return cls(problem, open_corrupted(problem, console), None, None, None, diffusion, precision)
        network = open_problem(problem, console)
        stored = None if table is None else read_deployed(table)
        if stored is not None and diffusion is not None:
            raise InputError("--table holds the weights; --diffusion was not expected")
        if stored is not None and tolerance[0] is not None and network.ambiguity is not None:
            raise InputError("--table holds the tolerance, and the problem has one; --tolerance was not expected")
        own = network.ambiguity if tolerance[0] is None else choose_ambiguity(network, *tolerance, None)
        return cls(problem, network, own, table, stored, diffusion, precision)


def compared(document: Any, rows: Sequence[Row], against: Against, console: Console) -> Iterator[Row]:
    """Whether the numbers of the certificate are those of a problem and of a table: a row a comparison.

    `rows` are those of its claims. Only valid claims are relied on, since only their form is known to be right.
    """
    from tolnet.certificates.document import OF_PROBLEM, OF_TABLE, differences
    from tolnet.model import InputError, SensorNetwork

    data, network, problem, stored = document["data"], against.network, against.problem, against.stored
    if not isinstance(network, SensorNetwork):
        from tolnet.cli.certify_channels import channel_differences

        wrong = channel_differences(data, network)
        yield compared_row("problem", problem, wrong, "plant, sensors and fading are the same")
        return
    try:
        deployed = _deployment(network, stored, against.diffusion, against.precision)
    except InputError as error:
        yield Row("deployment", str(against.table), "invalid", str(error))
        return
    wrong = differences(data, deployed, OF_PROBLEM)
    yield compared_row("problem", problem, wrong, "plant, sensors and graph are the same")
    yield from _tolerance_rows(document, against)
    if wrong:
        return
    if stored is None:
        wrong = differences(data, deployed, ("weights",))
        yield compared_row("weights", problem, wrong, "the weights are the problem's own")
        yield _gains_without_table(data, rows, network.N, problem, console)
    else:
        wrong = differences(data, deployed, OF_TABLE)
        yield compared_row("table", str(against.table), wrong, "gains and weights are the same")
    yield from _tolerances_of_nodes(rows, network.N, problem)
    if data["centre"] is not None:
        yield _worst_case(data, rows, network, against)
    if any(row.entry is not None and "c" in row.entry for row in rows):
        wrong = [*_numbers_of_claims(rows, network, against)]
        yield compared_row("claims", problem, wrong, "tolerances and initial covariances are those of the deployment")


def _deployment(
    network: SensorNetwork, stored: DeployedTable | None, diffusion: str | None, precision: str
) -> Deployed:
    """What a problem and a table say is deployed; without a table, gains of zero stand for what is not known."""
    import numpy as np

    from tolnet.certificates.deployed import Deployed
    from tolnet.design import diffusion_matrix

    if stored is not None:
        d = stored.deployment if precision == "float64" else stored.deployment.rounded(np.float32)
        return Deployed(network, d.offsets, d.neighbours, d.weights, d.columns, d.gains)
    heard = network.adjacency.tocsc()
    heard.sort_indices()
    hearer = np.repeat(np.arange(network.N), np.diff(heard.indptr))
    weights = np.asarray(diffusion_matrix(network, diffusion)[heard.indices, hearer]).ravel()
    if precision == "float32":
        weights = weights.astype(np.float32).astype(float)
    columns = np.concatenate([[0], np.cumsum(np.diff(network.rows)[heard.indices])])
    gains = np.zeros((int(columns[-1]), network.n))
    return Deployed(network, heard.indptr, heard.indices, weights, columns, gains)


# ---- Tolerances ----


def _tolerance_rows(document: Any, against: Against) -> Iterator[Row]:
    """Whether the table is one for the problem's tolerance, and whether the certificate is labelled with it.

    No claim rests on a label: where it says something else, what the certificate was made for is not known.
    """
    label = _other_tolerance((document["tolerance"], document["convention"], document["tau"]), against)
    if against.stored is not None:
        record = against.stored.record
        wrong = _other_tolerance((record.tolerance, record.convention, record.tau), against)
        right = "convention, tau and c are the problem's"
        yield compared_row("tolerance of the table", str(against.table), [wrong] if wrong else [], right)
    if label is not None:
        yield not_compared("label", against.problem, f"the certificate is labelled {label}")
    else:
        yield Row("label", against.problem, "valid", "convention, tau and c are the problem's")


def _other_tolerance(label: tuple[Any, Any, Any], against: Against) -> str | None:
    """What a certificate or a table says of its tolerance where the problem does not say the same."""
    from tolnet.model import Ambiguity

    said, own = _said(*label), against.ambiguity
    if not isinstance(said, Ambiguity):
        return said
    if own is None:
        return f"{_words(said)}, and the problem has no tolerance: --tolerance says which is meant"
    return None if (said.gamma, said.tau) == (own.gamma, own.tau) else f"{_words(said)} instead of {_words(own)}"


def _said(tolerance: Any, convention: Any, tau: Any) -> Ambiguity | str:
    """What labels say, or why they say nothing."""
    from tolnet.model import CONVENTIONS, Ambiguity, InputError

    if not (type(tolerance) in (int, float) and type(tau) in (int, float) and convention in CONVENTIONS):
        return "with no tolerance"
    try:
        return Ambiguity(float(tolerance), convention, float(tau))
    except InputError as error:
        return f"with no tolerance: {error}"


def _words(own: Ambiguity) -> str:
    return f"c = {own.tolerance!r} ({own.convention})" + (f", tau = {own.tau!r}" if own.tau else "")


def _tolerances_of_nodes(rows: Sequence[Row], nodes: int, problem: str) -> Iterator[Row]:
    """Whether each node's c, at which claims speak of its filter, is the one that follows from the network's."""
    own = {row.node: float.fromhex(entry["c"]) for row in rows if (entry := _of_a_node(row))}
    if not own:
        return
    enclosed, wrong, untied = valid(rows, "tolerance"), [], []
    for node, c in own.items():
        if node not in enclosed:
            untied.append(node)
            continue
        low, high = map(float.fromhex, enclosed[node]["interval"].split(" "))
        if not max(abs(c - low), abs(c - high)) <= ALIKE * c:
            wrong.append(f"node {node}: c = {c!r}, where its tolerance claim has [{low!r}, {high!r}]")
    if untied and not wrong:
        yield not_compared(
            "tolerances", problem, f"no valid tolerance claim ties c of {named(untied)} to the network's"
        )
        return
    right = f"the c of {len(own)} of {nodes} nodes are those that follow from the network's, within {ALIKE:g}"
    yield compared_row("tolerances", problem, wrong, right)


def _of_a_node(row: Row) -> dict[str, Any] | None:
    """A valid claim about the filter of a node at its own c."""
    speaks = isinstance(row.node, int) and row.claim != "tolerance"
    return row.entry if speaks and row.entry is not None and "c" in row.entry else None


def _numbers_of_claims(rows: Sequence[Row], network: SensorNetwork, against: Against) -> Iterator[str]:
    """The tolerances and initial covariances of valid claims that are not those of the deployment."""
    import numpy as np

    from tolnet.certificates.numerals import symmetric_matrix

    stored, own = against.stored, against.ambiguity
    whole = stored.tolerance if stored is not None else None if own is None else own.gamma
    for row in rows:
        if row.entry is None or "c" not in row.entry:
            continue
        c, node = float.fromhex(row.entry["c"]), row.node
        of_network = row.claim == "tolerance" or not isinstance(node, int)
        expected = whole if of_network else None if stored is None else float(stored.tolerances[node])
        if expected is not None and c != expected:
            yield f"claims[{row.index}].c: {c!r} instead of {expected!r}"
        if "start" in row.entry:
            start = symmetric_matrix(row.entry["start"])
            if not np.array_equal(start, network.initial_covariance):
                yield f"claims[{row.index}].start"


# ---- Gains ----


def _gains_without_table(data: Any, rows: Sequence[Row], nodes: int, problem: str, console: Console) -> Row:
    """Gains follow from a problem through a Riccati equation, which is not solved: `steady-state` ties them to it."""
    import numpy as np

    from tolnet.certificates.stated import stated_deployment

    tied = {node: entry for node, entry in valid(rows, "steady-state").items() if isinstance(node, int)}
    if len(tied) < nodes:
        why = f"steady states are proved of {len(tied)} of {nodes} nodes; --table FILE holds what is deployed"
        return not_compared("gains", problem, why)
    restless = [node for node in valid(rows, "attraction", "refuted") if isinstance(node, int)]
    if restless:
        why = f"the filters of {named(restless)} do not settle on their steady states; --table FILE holds the gains"
        return not_compared("gains", problem, why)
    deployed = stated_deployment(data)
    rounded = deployed.gains.astype(np.float32).astype(float)
    most = ALIKE_SINGLE if np.array_equal(rounded, deployed.gains) else ALIKE
    error = max(float.fromhex(entry["gain_error"]) for entry in tied.values())
    if not error <= most:
        far = f"its steady-state claims say within {error:.1e} of the exact gains only, and {most:g} is asked for"
        return compared_row("gains", problem, [far], "")
    distance = max(_distances(tied, deployed, console), key=lambda d: np.inf if d is None else d)
    if distance is None or not distance <= most:
        much = "an unknown part" if distance is None else f"{distance:.1e}"
        far = f"in the units of each state some gain is {much} off the exact one, and {most:g} is allowed"
        return compared_row("gains", problem, [far], "")
    within = f"within {error:.1e}, and {distance:.1e} in the units of each state"
    return Row("gains", problem, "valid", f"the gains are those of the exact steady states, {within}")


def _distances(tied: dict[Any, Any], deployed: Deployed, console: Console) -> list[float | None]:
    from functools import partial

    from tolnet.certificates.fixed_point import Box
    from tolnet.certificates.verify import gain_distances
    from tolnet.cli.parallel import in_parallel

    stated = [(node, float.fromhex(entry["c"]), Box.read(entry["proof"]["box"])) for node, entry in tied.items()]
    size = max(1, min(50, len(stated) // 16))
    parts = [stated[i : i + size] for i in range(0, len(stated), size)]
    with console.progress("gains") as progress:
        answers = in_parallel(partial(gain_distances, deployed=deployed), parts, progress)
        return [answer for part in answers for answer in part]


# ---- The least favourable model ----


def _worst_case(data: Any, rows: Sequence[Row], network: SensorNetwork, against: Against) -> Row:
    """Whether the stated model follows from the centre's exact steady state: linear equations, no Riccati equation.

    Differences of gains are judged in the units of each state, beside sqrt(P_ii), and those of the tilt T between
    factors of P = L L': with M M' <= P and (A - G C) P (A - G C)' <= P, what L' T L bounds is all of T that moves
    anything. Along directions that hardly vary, T is large, and rounding alone makes it another.
    """
    import numpy as np

    from tolnet import analysis
    from tolnet.certificates.fixed_point import Box
    from tolnet.certificates.stated import stated_deployment
    from tolnet.certificates.verify import exact_centre, gain_distances
    from tolnet.model.worst_case import psd_factor

    name = "least favourable model"
    entry = valid(rows, "steady-state").get("centre")
    if entry is None:
        return not_compared(name, against.problem, "no valid claim states the centre's steady state")
    c, box, deployed = float.fromhex(entry["c"]), Box.read(entry["proof"]["box"]), stated_deployment(data)
    exact, stated = exact_centre(c, box, deployed), deployed.centre
    (distance,) = gain_distances([("centre", c, box)], deployed)
    if exact is None or distance is None or stated is None:
        return not_compared(name, against.problem, "the centre's steady state was not enclosed once more")
    P, V, theta = exact
    unit, L = np.sqrt(np.diag(P)), psd_factor(P)
    wrong = []
    if not max(distance, float.fromhex(entry["gain_error"])) <= ALIKE:
        wrong.append("the centre's gain")
    if against.stored is not None:
        pairs = {"central P": (against.stored.central_P, P), "central V": (against.stored.central_V, V)}
        wrong += [f"{key} of the table" for key, (a, b) in pairs.items() if not _alike(a, b, 1 / unit)]
        if not abs(float(against.stored.record.central["theta"]) - theta) <= ALIKE * theta:
            wrong.append("theta of the table")
    try:
        worst = analysis.least_favourable_model(network, analysis.restore_steady_state(network, c, P, V, theta))
    except (ValueError, ArithmeticError):
        return not_compared(name, against.problem, "the model that follows was not computed")
    if not worst.exists:
        wrong.append("whether there is one")
    elif not _alike(*(L.T @ T @ L for T in (stated.tilt @ stated.tilt.T, worst.tilt)), np.ones(len(P))):
        wrong.append("its tilt")
    right = f"the stated model follows from the centre's exact steady state, within {ALIKE:g}"
    return compared_row(name, against.problem, wrong, right)


def _alike(a: Any, b: Any, unit: Any) -> bool:
    """Whether |a - b|_ij <= ALIKE max |b|, entries times the units of their row and column."""
    import numpy as np

    if a.shape != b.shape or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    scale = unit[:, None] * unit
    return bool((np.abs(a - b) * scale).max(initial=0.0) <= ALIKE * (np.abs(b) * scale).max(initial=0.0))
