"""Quantities that may depend on the instant: constant, periodic, or a function of k."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet.model._checks import Complaints, frozen
from tolnet.model.errors import InputError
from tolnet.model.sensors import by_node

_REMEMBERED = 512
"""How many instants of a function are kept, so that several passes over a horizon call it once for each k."""

Parse = Callable[[Any, str, Complaints], "ndarray | None"]
"""Checks what a user wrote for one instant under a key path: an array, or None with a complaint."""


@dataclass(frozen=True, eq=False)
class TimeVarying:
    """A quantity at every instant k = 0, 1, ...: `network.A(k)`.

    `values` holds one period of it along a leading axis, of length 1 where it is constant; or it is None, and the
    quantity is a `function` of k, whose values are checked when they are asked for.
    """

    values: ndarray | None
    function: Callable[[int], ndarray] | None = None

    def __post_init__(self) -> None:
        if self.values is not None:
            frozen(self.values)

    def __call__(self, k: int) -> ndarray:
        """The value at instant k. Raises InputError where a function gives there what is not allowed."""
        if self.values is not None:
            return self.values[k % len(self.values), ...]
        assert self.function is not None
        return self.function(k)

    @property
    def period(self) -> int | None:
        """After how many instants it repeats: 1 for a constant; None for a function, of which that is not known."""
        return None if self.values is None else len(self.values)

    @property
    def one_period(self) -> ndarray:
        """The values with their leading axis. Raises InputError for a function, which has none."""
        if self.values is None:
            raise InputError("is a function of k; a constant or periodic quantity was expected")
        return self.values

    @property
    def given(self) -> Any:
        """The same as constructors take it: an array, without an axis for a period of one, or the function."""
        if self.values is None:
            return self.function
        return self.values[0] if len(self.values) == 1 else self.values

    def times(self, factor: float) -> TimeVarying:
        """The same quantity multiplied by a factor."""
        if self.values is not None:
            return TimeVarying(self.values * factor)
        return function_of_time(lambda k: self(k) * factor)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.values is not None:
            frozen(self.values)


def constant(value: Any) -> TimeVarying:
    """The same value at every instant."""
    return TimeVarying(np.asarray(value, dtype=float)[None].copy())


def function_of_time(function: Callable[[int], ndarray]) -> TimeVarying:
    """A function of k, whose recent values are kept and read-only."""
    return TimeVarying(None, lru_cache(maxsize=_REMEMBERED)(lambda k: frozen(function(k))))


def common_period(parts: Iterable[TimeVarying]) -> int | None:
    """After how many instants all of them repeat; None where one is a function."""
    periods = [part.period for part in parts]
    known = [period for period in periods if period is not None]
    return math.lcm(*known) if len(known) == len(periods) else None


def over_time(value: Any, ndim: int, key: str, parse: Parse, complaints: Complaints) -> TimeVarying | None:
    """What a user wrote for a quantity that has `ndim` axes at each instant; None, with complaints, if it is wrong.

    One more axis in front is one period; a callable is called with k. Complaints about instant t of a period point to
    `key[t]`; of a function, instant 0 is judged at once and the others when they are used.
    """
    if callable(value):

        def at(k: int) -> ndarray:
            found = Complaints()
            array = parse(value(k), f"{key}({k})", found)
            found.raise_if_any()
            assert array is not None
            return array

        try:
            at(0)
        except InputError as error:
            complaints.extend(error)
            return None
        return function_of_time(at)
    if depth(value) != ndim + 1:
        array = parse(value, key, complaints)
        return None if array is None else TimeVarying(array[None])
    if not len(value):
        complaints.add(key, "is empty; one period was expected")
        return None
    instants = [parse(value[t], f"{key}[{t}]", complaints) for t in range(len(value))]
    found = [array for array in instants if array is not None]
    alike = len({array.shape for array in found}) == 1  # they differ only where the size of the plant is not known
    return TimeVarying(np.stack(found)) if len(found) == len(instants) and alike else None


def depth(value: Any) -> int:
    """How many axes an array or nested lists have, judged by their first entries."""
    if isinstance(value, ndarray):
        return value.ndim
    levels = 0
    while isinstance(value, Sequence) and not isinstance(value, str | bytes):
        levels += 1
        if not value:
            break
        value = value[0]
    return levels + (value.ndim if isinstance(value, ndarray) else 0)


@dataclass(frozen=True)
class PerNode:
    """What a user wrote for one quantity of all nodes: an array, or one item a node, each with a period of its own.

    An item has `ndim` axes, an array of all nodes has as many as one of `whole` says; one axis in front of either is
    a period. A callable gives all of that for instant k.
    """

    value: Any
    ndim: int
    whole: tuple[int, ...]

    @property
    def periods(self) -> set[int]:
        """The lengths of the periods in it; empty for a callable."""
        if callable(self.value) or self.value is None:
            return set()
        if by_node(self.value):
            return {len(item) for item in self.value if self._periodic(item)} - {0}
        axes = self.value.ndim if isinstance(self.value, ndarray) else 0
        return {len(self.value)} - {0} if axes not in self.whole and axes - 1 in self.whole else set()

    def at(self, k: int) -> Any:
        """The same at instant k, without any period."""
        if callable(self.value):
            return self.value(k)
        if by_node(self.value):
            return [item[k % len(item)] if self._periodic(item) and len(item) else item for item in self.value]
        return self.value[k % len(self.value)] if self.periods else self.value

    def _periodic(self, item: Any) -> bool:
        return depth(item) == self.ndim + 1


def all_nodes_over_time(
    sources: Sequence[PerNode],
    parse: Callable[[Sequence[Any], Complaints], Sequence[ndarray] | None],
    complaints: Complaints,
) -> tuple[TimeVarying, ...] | None:
    """Quantities of all nodes that are judged together, such as C and R, over their common period or as functions.

    `parse` judges one instant. A key that is wrong at several instants is told of once, with the first of them.
    """
    if any(callable(source.value) for source in sources):
        return _functions(sources, parse, complaints)
    T = math.lcm(*(period for source in sources for period in source.periods))
    instants: list[Sequence[ndarray]] = []
    told: set[str] = set()
    for t in range(T):
        found = Complaints()
        arrays = parse([source.at(t) for source in sources], found)
        for complaint in found.found:
            if complaint.key not in told:
                told.add(complaint.key)
                place = f" (at instant {t} of the period of {T})" if T > 1 else ""
                complaints.add(complaint.key, complaint.message + place, shape=found.only_shapes)
        if arrays is not None and not found.found:
            instants.append(arrays)
    if len(instants) < T:
        return None
    return tuple(TimeVarying(np.stack([arrays[i] for arrays in instants])) for i in range(len(instants[0])))


def _functions(
    sources: Sequence[PerNode],
    parse: Callable[[Sequence[Any], Complaints], Sequence[ndarray] | None],
    complaints: Complaints,
) -> tuple[TimeVarying, ...] | None:
    @lru_cache(maxsize=_REMEMBERED)
    def at(k: int) -> Sequence[ndarray]:
        found = Complaints()
        arrays = parse([source.at(k) for source in sources], found)
        if found.found or arrays is None:
            raise InputError([type(each)(f"{each.key}({k})", each.message) for each in found.found])
        return arrays

    try:
        count = len(at(0))
    except InputError as error:
        complaints.extend(error)
        return None

    def part(i: int) -> TimeVarying:
        return function_of_time(lambda k: at(k)[i])

    return tuple(part(i) for i in range(count))
