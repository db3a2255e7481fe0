"""The time that a verification may take: whoever checks a stranger's certificate must not wait for ever."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from tolnet.model import TolnetError

_end: ContextVar[float] = ContextVar("end", default=math.inf)


class OutOfTime(TolnetError):
    """A verification was given up, which says nothing about the claim."""


@contextmanager
def until(end: float) -> Iterator[None]:
    """Work that ends at this instant of `time.monotonic`, which all processes of a machine share."""
    token = _end.set(end)
    try:
        yield
    finally:
        _end.reset(token)


def check_clock() -> None:
    """Raise OutOfTime once the time is over: called in every loop whose length a certificate states."""
    if time.monotonic() > _end.get():
        raise OutOfTime("it takes too long")
