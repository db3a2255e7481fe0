"""Work on many filters at once, on all cores where there are many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

Case = TypeVar("Case")
Answer = TypeVar("Answer")

_SEQUENTIAL_UP_TO = 4
"""Cases that are worked on here and now, since starting processes would take longer."""


def in_parallel(
    work: Callable[[Case], Answer], cases: Sequence[Case], progress: Callable[[int, int], None] | None = None
) -> Iterator[Answer]:
    """The answers in the order of the cases, whatever the number of processes."""
    for done, answer in enumerate(_run(work, cases), start=1):
        yield answer
        if progress is not None:
            progress(done, len(cases))


def _run(work: Callable[[Case], Answer], cases: Sequence[Case]) -> Iterator[Answer]:
    if len(cases) <= _SEQUENTIAL_UP_TO:
        return map(work, cases)
    import joblib

    kind: Any = joblib.Parallel
    parallel = kind(n_jobs=-1, return_as="generator", batch_size=1)
    return parallel(joblib.delayed(work)(case) for case in cases)
