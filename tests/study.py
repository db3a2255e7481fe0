"""How much is tried: `make test` takes the quick sizes, `make study` (TOLNET_STUDY=full) the full ones.

One switch for all: sizes by `sized`, whole tests by `@pytest.mark.study`, Hypothesis by its profile, shapes at every
call. What is left for the study is more of the same: each thing that is proved has a quick test as well.
"""

from __future__ import annotations

import os
from typing import TypeVar

from hypothesis import settings

FULL = os.environ.get("TOLNET_STUDY") == "full"
FAST, QUICK, MANY = 3, 25, 300
"""Examples of Hypothesis in `make test-fast`, `make test` and `make study`."""

T = TypeVar("T")


def sized(quick: T, full: T) -> T:
    """The one for `make test`, or the one for `make study`."""
    return full if FULL else quick


def load_hypothesis_profile(*, fast: bool) -> None:
    """No deadline, for loaded machines; the same examples in every run of `make test`, new ones in the study."""
    settings.register_profile("fast", deadline=None, max_examples=FAST, derandomize=True, database=None)
    settings.register_profile("quick", deadline=None, max_examples=QUICK, derandomize=True, database=None)
    settings.register_profile("study", deadline=None, max_examples=MANY)
    settings.load_profile("fast" if fast else sized("quick", "study"))


def few() -> settings:
    """A third of the profile's examples, for properties that take long; to be called after the profile is loaded."""
    return settings(max_examples=max(settings().max_examples // 3, FAST))
