"""Why a filter has no answer, in words: the one place where such messages are made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from tolnet.analysis import Detectability, Mode, detectability
from tolnet.design.smaller_tolerance import at_little_tolerance
from tolnet.model import Status, SteadyState, ToleranceTable

NAMED_AT_MOST = 10
_MODES_AT_MOST = 3
_STATES_AT_MOST = 4


def _ended(filter: SteadyState) -> str:
    """What ended the search, in brackets, where that is known."""
    return f" ({filter.reason})" if str(filter.reason) else ""


class Reasons:
    """The statuses of a table's filters, and what they mean for their deployment."""

    def __init__(self, table: ToleranceTable) -> None:
        self._table = table

    def of(self, k: int | None) -> str | None:
        """Why the filter of node k (None: of the centre) is not ok; None where it is."""
        filter = self._table.central if k is None else self._table.local[k]
        return None if filter.settles else self._reason(filter, k)

    def offenders(self) -> Iterator[str]:
        """One line for the centre and for each node that is not ok, up to NAMED_AT_MOST nodes, and how many more."""
        table, network = self._table, self._table.network
        if not table.central.settles:
            yield f"central filter: {table.central.status}: {self.of(None)}"
        bad = np.flatnonzero(~table.local.settles)
        for k in bad[:NAMED_AT_MOST].tolist():
            name = f" ({network.label(k)})" if network.names else ""
            yield f"node {k}{name}: {table.local.status[k]}: {self.of(k)}"
        if bad.size > NAMED_AT_MOST:
            yield f"... and {bad.size - NAMED_AT_MOST:,} more nodes; --json names them all"

    @cached_property
    def _seen(self) -> Detectability:
        return detectability(self._table.network)

    def _reason(self, filter: SteadyState, k: int | None) -> str:
        seen, status = self._seen, str(filter.status)
        if k is not None and not np.isfinite(filter.tolerance) and not seen.offending(k) and seen.stabilisable:
            return "the central filter has no answer, so there is no c_k"
        match status:
            case Status.UNDETECTABLE:
                heard = "no sensor" if k is None else f"no sensor that it hears ({self._heard(k)})"
                modes = seen.offending(k)
                decay = "do not decay" if len(modes) > 1 else "does not decay"
                return f"{heard} sees all of {self._named(modes)}, which {decay}"
            case Status.UNSTABILISABLE:
                modes = seen.offending_undriven()
                circle = "lie on the unit circle" if len(modes) > 1 else "lies on the unit circle"
                return f"the process noise does not drive all of {self._named(modes)}, which {circle}"
            case Status.OSCILLATES:
                return (
                    "a steady state exists, but the filter never settles on it (attraction"
                    f" {float(filter.attraction):.4g} is not below 1){self._way_out(k, 'it settles')}"
                )
            case Status.DIVERGES:
                return f"the covariance grows without bound at this tolerance{self._way_out(k, 'there is an answer')}"
            case _ if filter.tolerance == 0:
                return f"no Kalman filter was found{_ended(filter)}"
            case _:
                return f"none was found at this tolerance{_ended(filter)}{self._way_out(k, 'there is an answer')}"

    def _way_out(self, k: int | None, helped: str) -> str:
        """Whether a smaller tolerance helps: at hardly any, this filter was tried."""
        little = self._at_little.central if k is None else self._at_little.local[k]
        return (
            f"; at a smaller tolerance {helped}"
            if little.settles
            else f", nor at {little.tolerance:.3g} (gamma scale)"
        )

    @cached_property
    def _at_little(self) -> ToleranceTable:
        return at_little_tolerance(self._table, uniform=self._table.tau != 0)

    def _heard(self, k: int) -> str:
        heard = self._table.network.neighbours(k).tolist()
        more = ", ..." if len(heard) > NAMED_AT_MOST else ""
        return f"node{'s' if len(heard) > 1 else ''} {', '.join(map(str, heard[:NAMED_AT_MOST]))}{more}"

    def _named(self, modes: Sequence[Mode]) -> str:
        """Modes of A as people write eigenvalues, each with the labels of the states that carry it."""
        shown = ", ".join(str(mode) + self._carriers(mode) for mode in modes[:_MODES_AT_MOST])
        more = ", ..." if len(modes) > _MODES_AT_MOST else ""
        return f"the mode{'s' if len(modes) > 1 else ''} {shown}{more} of A"

    def _carriers(self, mode: Mode) -> str:
        labels = self._table.network.states
        if not labels:
            return ""
        more = ", ..." if len(mode.states) > _STATES_AT_MOST else ""
        return f" ({', '.join(labels[j] for j in mode.states[:_STATES_AT_MOST])}{more})"
