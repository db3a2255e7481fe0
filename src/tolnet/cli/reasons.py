"""Why a filter has no answer, in words: the one place where such messages are made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tolnet.analysis import Detectability, detectability
from tolnet.model import Status, SteadyState, ToleranceTable

NAMED_AT_MOST = 10
_MODES_AT_MOST = 3


def offenders(table: ToleranceTable) -> Iterator[str]:
    """One line for the centre and for each node that is not ok, up to NAMED_AT_MOST nodes, and how many more."""
    seen = detectability(table.network)
    if not table.central.settles:
        yield f"central filter: {_reason(table, table.central, seen, None)}"
    bad = np.flatnonzero(~table.local.settles)
    for k in bad[:NAMED_AT_MOST].tolist():
        name = f" ({table.network.label(k)})" if table.network.names else ""
        yield f"node {k}{name}: {_reason(table, table.local[k], seen, k)}"
    if bad.size > NAMED_AT_MOST:
        yield f"... and {bad.size - NAMED_AT_MOST:,} more nodes; --json names them all"


def _reason(table: ToleranceTable, filter: SteadyState, seen: Detectability, k: int | None) -> str:
    """The status of the filter of node k (None: of the centre), and what it means for its deployment."""
    status = str(filter.status)
    if k is not None and not np.isfinite(filter.tolerance) and seen.detectable[k] and seen.stabilisable:
        return f"{status}: the central filter has no answer, so there is no c_k"
    match status:
        case Status.UNDETECTABLE:
            heard = "no sensor" if k is None else f"no sensor that it hears (nodes {_listed(table, k)})"
            return f"{status}: {heard} sees all of {_modes(seen.offending(k))}"
        case Status.UNSTABILISABLE:
            return f"{status}: the process noise does not drive all of {_modes(seen.offending_undriven())}"
        case Status.OSCILLATES:
            return (
                f"{status}: a steady state exists, but the filter never settles on it (attraction"
                f" {float(filter.attraction):.4g} is not below 1); a smaller tolerance settles"
            )
        case Status.DIVERGES:
            return f"{status}: the covariance grows without bound at this tolerance; a smaller one may have an answer"
        case _:
            return f"{status}: none was found at this tolerance; a smaller one may have an answer"


def _modes(modes: Sequence[object]) -> str:
    """The modes of A that do not decay, as people write eigenvalues."""
    shown = ", ".join(map(str, modes[:_MODES_AT_MOST])) + (", ..." if len(modes) > _MODES_AT_MOST else "")
    return (
        f"the mode{'s' if len(modes) > 1 else ''} {shown} of A, which {'do' if len(modes) > 1 else 'does'} not decay"
    )


def _listed(table: ToleranceTable, k: int) -> str:
    heard = table.network.neighbours(k).tolist()
    return ", ".join(map(str, heard[:NAMED_AT_MOST])) + (", ..." if len(heard) > NAMED_AT_MOST else "")
