"""Shape annotations enforced at run time, at a price that tests can pay.

jaxtyping with beartype takes a quarter of a millisecond a call: more than half of all time here went into looking at
the same shapes again, in loops that call one function a thousand times. So each is checked at its first calls of
each test, and from then on at one call in `EVERY` (a prime, so that it meets all calls of a loop in turn). With
TOLNET_STUDY=full every call is checked. Functions that are never called cost nothing: checks are made when needed.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jaxtyping
from tests.study import sized

FIRST = 5
EVERY = sized(23, 1)

_enforce = jaxtyping.jaxtyped
_test = [0]


def next_test() -> None:
    """From here on, the first calls of every function are checked again."""
    _test[0] += 1


def install(package: str) -> None:
    """Enforce the annotations of a package that is not imported yet."""
    jaxtyping.jaxtyped = now_and_then  # what the import hook puts above every function and class
    jaxtyping.install_import_hook([package], "beartype.beartype")


def now_and_then(fn: Any = None, *, typechecker: Any) -> Any:
    """The decorator `jaxtyping.jaxtyped`, but for how often it looks."""
    again = functools.partial(now_and_then, typechecker=typechecker)
    match fn:
        case None:
            return again
        case type():
            if "__dataclass_fields__" in vars(fn) and "__init__" in vars(fn):
                fn.__init__ = again(fn.__init__)
            return fn
        case classmethod() | staticmethod():
            return type(fn)(again(fn.__func__))
        case property():
            return property(*(part and again(part) for part in (fn.fget, fn.fset, fn.fdel)))
        case _ if inspect.isfunction(fn):
            return _sampled(fn, typechecker)
    return _enforce(fn, typechecker=typechecker)


def _sampled(fn: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    checked: Callable[..., Any] | None = None
    calls, test = 0, -1

    @functools.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checked, calls, test
        if test != _test[0]:
            calls, test = 0, _test[0]
        calls += 1
        if calls > FIRST and calls % EVERY:
            return fn(*args, **kwargs)
        if checked is None:
            checked = _enforce(fn, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call
