"""Robust collective observability, eqs. (6) and (11): whether, with which window, and where it is weak."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from tolnet.analysis.fading_information import exact_rows, rows_given_moment, rows_given_norm
from tolnet.analysis.lost_modes import lost_modes
from tolnet.analysis.second_moment import (
    SecondMomentLimit,
    norm_limit,
    norm_recursion,
    second_moment_limit,
    second_moments,
    transient,
)
from tolnet.model import CorruptedNetwork, InputError, UnsupportedError
from tolnet.model.observability import FORMS, Form, RobustObservability

Progress = Callable[[int, int], None]

_SINGULAR = 1e-12  # smallest singular value, columns scaled to one, below which a window sees nothing somewhere
_FAR, _TOO_FAR = 1e120, 1e150  # rows whose squares are near the end of doubles, and beyond it
_CHUNK = 2_000_000  # numbers in one stack of factors of all nodes
_EVERY_START = 100_000  # pairs of a node and a start beyond which nodes are told apart by the weakest starts only


class _Path(NamedTuple):
    """A stretch of instants: their plants and rows, and which instant follows which.

    Without a horizon the last T instants stand for the limit, and the last is followed by the first of them.
    """

    A: Float[ndarray, "K n n"]
    Y: Float[ndarray, "K N p n"]
    limit: int
    """How many instants stand for the limit; 0 with a horizon."""

    @property
    def all_factors(self) -> Float[ndarray, "K n n"]:
        """Of all nodes together at one instant."""
        K, _, _, n = self.Y.shape
        return triangle(self.Y.reshape(K, -1, n))

    def lengthened(
        self, one: Float[ndarray, "K *N p n"], factors: Float[ndarray, "J *N n n"]
    ) -> Float[ndarray, "I *N n n"]:
        """Windows of one more instant: R_{k,L+1} = [Y_k; R_{k+1,L} A_k], for every k for which there is one."""
        following = factors[1:]
        if self.limit:
            following = np.concatenate([following, factors[-self.limit][None]])
        if not len(following):
            return following
        A = self.A[: len(following)].reshape(len(following), *(1,) * (one.ndim - 3), *self.A.shape[1:])
        with np.errstate(over="ignore", invalid="ignore"):
            rows = np.concatenate([one[: len(following)], following @ A], axis=-2)
        if not np.abs(rows).max(initial=0.0) < _TOO_FAR:
            raise InputError(
                "a window is so long that what it sees is beyond the range of doubles; a shorter one was expected"
            )
        return triangle(rows)

    def windows(self, one: Float[ndarray, "K *N p n"], L: int) -> Float[ndarray, "I *N n n"]:
        """Factors of the windows of L instants, from the rows of single instants."""
        factors = triangle(one)
        for _ in range(L - 1):
            factors = self.lengthened(one, factors)
        return factors


    def windows_from(self, starts: Int[ndarray, " k"], L: int) -> Float[ndarray, "k N n n"]:
        """Factors of every node for the windows that begin at `starts`."""
        K = len(self.Y)
        following = np.append(np.arange(1, K), K - self.limit) if self.limit else np.arange(1, K + 1)
        Phi, rows, at = np.broadcast_to(np.eye(self.A.shape[1]), (len(starts), *self.A.shape[1:])), [], starts
        for _ in range(L):
            rows.append(self.Y[at] @ Phi[:, None])
            Phi, at = self.A[at] @ Phi, following[at]
        return triangle(np.concatenate(rows, axis=-2))


def robust_observability(
    network: CorruptedNetwork,
    *,
    form: Form = "sharp",
    horizon: int | None = None,
    window: int | None = None,
    progress: Progress | None = None,
) -> RobustObservability:
    """Test sum_{i,s} tau^2 Phi_{s,k}' C' Rt^-1 C Phi_{s,k} >= alpha I over windows of instants s = k, ..., k + L - 1.

    `form` "sharp" has Rt = R + phi C Pi_s C' with the second moment itself, eq. (11), "stated" has R + phi pi_s C C'
    with the recursion of its norm, eq. (6), and "classical" tau = 1, phi = 0. With a `horizon` H the windows lie
    within 0..H; without one they begin at every k = 0, 1, ..., of a periodic network: until the second moment is at
    its limit, and in the limit, where a fading sensor that sees a growing direction counts for nothing. `window` is L;
    None takes the smallest for which the condition holds, at most n periods (after which nothing new is seen).
    Raises UnsupportedError for functions of k without a horizon; InputError for an unknown form or a window that is
    below 1 or longer than the horizon.
    Source: Assumption 3.1 and Lemma 3.4; docs/mathematics.md, section 13.3.
    """
    if form not in FORMS:
        raise InputError(f"there is no form {form!r}; the forms are {', '.join(FORMS)}")
    if horizon is not None and horizon < 0:
        raise InputError(f"the horizon is {horizon}; a number >= 0 was expected")
    if window is not None and (window < 1 or (horizon is not None and window > horizon + 1)):
        raise InputError(f"the window is {window}; 1 to {'any' if horizon is None else horizon + 1} was expected")
    limit = second_moment_limit(network) if form == "sharp" and network.period is not None else None
    path = _path(network, form, horizon, limit)
    L, by_window = _find_window(path, window, _longest(network, horizon))
    factors = path.windows(path.Y.reshape(len(path.Y), -1, network.n), L)
    alpha, seen = smallest(factors)
    worst = int(np.argmin(alpha))
    known = len(alpha) - path.limit
    report = _Nodes(path, network, L, factors, progress)
    lost = () if limit is None or horizon is not None else lost_modes(network, limit)
    growing = np.zeros((network.n, 0)) if limit is None or horizon is not None else limit.U[0]
    found = RobustObservability(
        network=network,
        form=form,
        horizon=horizon,
        window=L,
        holds=bool(seen.all()),
        alpha=float(alpha[worst]),
        worst_start=worst if worst < known or not known else None,
        weakest_direction=_direction(factors[worst]),
        alpha_by_window=np.array(by_window),
        alpha_over_time=alpha[:known] if known else alpha,
        alpha_limit=alpha[known:] if path.limit else None,
        **report.found,
        growing=growing,
        lost=lost,
        reason="",
    )
    return found if found.holds else _explained(found)


def triangle(rows: Float[ndarray, "*K p n"]) -> Float[ndarray, "*K n n"]:
    """R with R'R = Y'Y for stacks of rows Y, so that no digits are lost by squaring."""
    *stack, p, n = rows.shape
    if p < n:
        rows = np.concatenate([rows, np.zeros((*stack, n - p, n))], axis=-2)
    return np.asarray(np.linalg.qr(rows, mode="r")) if rows.size else np.zeros((*stack, n, n))


def smallest(factors: Float[ndarray, "*K n n"]) -> tuple[Float[ndarray, "*K"], Bool[ndarray, "*K"]]:
    """The smallest eigenvalue of R'R, and whether it counts as positive whatever the units; 0 where it does not."""
    size = np.linalg.norm(factors, axis=-2)
    scaled = factors / np.where(size > 0, size, 1.0)[..., None, :]
    seen = np.asarray(np.linalg.svd(scaled, compute_uv=False)[..., -1] > _SINGULAR)
    values = np.linalg.svd(factors, compute_uv=False)[..., -1] ** 2
    return np.where(seen, values, 0.0), seen


def _direction(factor: Float[ndarray, "n n"]) -> Float[ndarray, " n"]:
    """The unit vector that R sees least, its largest component positive."""
    v = np.linalg.svd(factor)[2][-1]
    return v * np.sign(v[np.argmax(np.abs(v))])


def _path(network: CorruptedNetwork, form: Form, horizon: int | None, limit: SecondMomentLimit | None) -> _Path:
    T = network.period
    if horizon is None and T is None:
        raise UnsupportedError("some matrix is a function of k; give a horizon")
    count = 0 if horizon is None else horizon + 1
    Y: list[ndarray] = []
    if form == "classical":
        Y = [exact_rows(network, k) for k in range(count or (T or 0))]
    elif form == "stated":
        ends = None if horizon is not None else norm_limit(network)
        K = count if ends is None else _settling(network, ends)
        Y = [rows_given_norm(network, k, pi) for k, pi in zip(range(K), norm_recursion(network, K), strict=False)]
        if ends is not None:
            Y += [rows_given_norm(network, k, float(ends[k % len(ends)])) for k in range(K, K + len(ends))]
    elif horizon is not None:
        moments = second_moments(network, limit)
        Y = [rows_given_moment(network, k, next(moments)).Y for k in range(count)]
    elif limit is not None:
        passing = transient(network, limit)
        K = len(passing)
        Y = [rows_given_moment(network, k, moment).Y for k, moment in enumerate(passing)]
        Y += [rows_given_moment(network, k, limit.at(k)).Y for k in range(K, K + len(limit.Pi))]
    A = np.stack([network.A(k) for k in range(len(Y))])
    return _Path(A, np.stack(Y), 0 if horizon is not None else (T or 0))


def _settling(network: CorruptedNetwork, ends: Float[ndarray, " T"]) -> int:
    """After how many instants the norm recursion is at its limit, or beyond everything."""
    if not any(network.phi(t).any() for t in range(len(ends))):
        return 0
    K = 5000
    pi = norm_recursion(network, K)
    goal = ends[np.arange(K + 1) % len(ends)]
    near = pi > 1e12 * pi[0] if np.isinf(ends[0]) else np.abs(pi - goal) <= 1e-12 * goal
    return int(np.argmax(near)) if near.any() else K


def _longest(network: CorruptedNetwork, horizon: int | None) -> int:
    """The longest window that can tell anything: n periods, after which Cayley-Hamilton says that nothing is new."""
    return network.n * (network.period or 1) if horizon is None else horizon + 1


def _find_window(path: _Path, window: int | None, longest: int) -> tuple[int, list[float]]:
    """The window asked for, or the smallest for which all windows see everything, or n where none does; alpha by L."""
    one, n = path.Y.reshape(len(path.Y), -1, path.A.shape[1]), path.A.shape[1]
    shown = min(max(n, window or 0), longest)
    factors, by_window, first = triangle(one), [], None
    doomed = window is None and not _ever_seen(path, longest)
    for L in range(1, longest + 1):
        if L > 1:
            if window is None and np.abs(factors).max(initial=0.0) > _FAR:
                break  # longer ones are near the end of doubles, and no shorter one sees everything
            factors = path.lengthened(one, factors)
        alpha, seen = smallest(factors)
        by_window.append(float(alpha.min()))
        first = L if first is None and seen.all() else first
        if L >= shown and (first is not None or window is not None or doomed):
            break
    return window or first or shown, by_window


def _ever_seen(path: _Path, longest: int) -> bool:
    """Whether the longest windows see everything, by doubling the window; with a horizon, the one longest window."""
    one = path.Y.reshape(len(path.Y), -1, path.A.shape[1])
    if not path.limit:
        seen = triangle(one[-1])
        for Y, A in zip(one[-2::-1], path.A[-2::-1], strict=True):
            moved = seen @ A  # directions matter here, sizes do not
            seen = triangle(np.concatenate([Y, moved / max(1.0, float(np.abs(moved).max(initial=0.0)))]))
        return bool(smallest(seen[None])[1].all())
    K = len(one)
    following = np.append(np.arange(1, K), K - path.limit)
    factors, Phi, L = triangle(one), path.A, 1
    with np.errstate(over="ignore", invalid="ignore"):
        while L < longest:
            size = np.maximum(np.abs(Phi).max(axis=(1, 2), keepdims=True), 1e-300)
            factors = triangle(np.concatenate([factors, factors[following] @ Phi], axis=1))
            Phi = (Phi / size)[following] @ Phi  # directions matter here, sizes do not
            following, L = following[following], 2 * L
    return bool(smallest(factors)[1].all())


class _Nodes:
    """What each node, and each sensor that might be added, changes; over all windows, a few at a time.

    Where nodes times windows are more than _EVERY_START, over the windows that say least and those of the limit.
    """

    def __init__(
        self,
        path: _Path,
        network: CorruptedNetwork,
        L: int,
        factors: Float[ndarray, "K n n"],
        progress: Progress | None,
    ) -> None:
        N, n = network.N, network.n
        variances = np.concatenate(
            [np.einsum("kpp->kp", R).ravel() for _, _, R in network.sensors(0).groups()] or [[1.0]]
        )
        r = float(np.median(variances))
        states = np.broadcast_to(np.eye(n)[:, None, :] / np.sqrt(r), (len(path.A), n, 1, n))
        extra = path.windows(states, L)
        found = {
            "alpha_without_node": np.full(N, np.inf),
            "alpha_of_node": np.full(N, np.inf),
            "alpha_with_copy": np.full(N, np.inf),
            "alpha_with_state": smallest(triangle(np.concatenate([factors[:, None].repeat(n, 1), extra], -2)))[0].min(
                0
            ),
        }
        alone = np.ones(N, dtype=bool)
        own = path.windows(path.Y, L) if len(factors) * N <= _EVERY_START else None
        starts = np.arange(len(factors))
        if own is None:
            starts = _weakest(factors, path.limit, max(1, _EVERY_START // N))
        step = max(1, _CHUNK // (N * n * n))
        for begin in range(0, len(starts), step):
            chosen = starts[begin : begin + step]
            part = path.windows_from(chosen, L) if own is None else own[chosen]
            whole = np.broadcast_to(factors[chosen, None], part.shape)
            alpha, seen = smallest(part)
            alone &= seen.all(axis=0)
            _lower(found["alpha_of_node"], alpha)
            _lower(found["alpha_with_copy"], smallest(triangle(np.concatenate([whole, part], axis=-2)))[0])
            _lower(found["alpha_without_node"], smallest(_all_but_one(part))[0])
            if progress is not None:
                progress(min(begin + step, len(starts)), len(starts))
        self.found = {**found, "holds_of_node": alone, "added_variance": r}


def _weakest(factors: Float[ndarray, "K n n"], limit: int, count: int) -> Int[ndarray, " k"]:
    """The starts whose windows say least, and as many of the limit as there is room for."""
    last = np.arange(len(factors) - limit, len(factors))[:count]
    order = np.argsort(smallest(factors)[0], kind="stable")
    return np.unique(np.concatenate([last, order[: max(1, count - len(last))]]))


def _lower(least: Float[ndarray, " N"], alpha: Float[ndarray, "K N"]) -> None:
    np.minimum(least, alpha.min(axis=0), out=least)


def _all_but_one(own: Float[ndarray, "K N n n"]) -> Float[ndarray, "K N n n"]:
    """Factors of all nodes but each one, from those before it and those after it; nothing is ever subtracted."""
    N = own.shape[1]
    before, after = np.zeros_like(own), np.zeros_like(own)
    for i in range(1, N):
        before[:, i] = triangle(np.concatenate([before[:, i - 1], own[:, i - 1]], axis=-2))
        j = N - 1 - i
        after[:, j] = triangle(np.concatenate([after[:, j + 1], own[:, j + 1]], axis=-2))
    return triangle(np.concatenate([before, after], axis=-2))


def _explained(found: RobustObservability) -> RobustObservability:
    """The same, saying why it does not hold."""
    from dataclasses import replace

    def words(direction: ndarray) -> str:
        return " ".join(f"{value:+.3g} {state}" for state, value in found.named(direction))

    def nodes(which: Int[ndarray, " m"] | tuple[int, ...]) -> str:
        names = [found.network.label(int(i)) for i in which]
        few = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        return f"node {few}" if len(names) == 1 else f"nodes {few}"

    weakest = words(found.weakest_direction)
    seen = [mode for mode in found.lost if mode.nodes]
    if len(seen) < len(found.lost):
        mode = next(mode for mode in found.lost if not mode.nodes)
        said = f"no sensor sees the mode along {words(np.array(mode.direction))}, which does not decay"
    elif seen:
        mode = seen[0]
        said = (
            f"the mode along {words(np.array(mode.direction))} does not decay and is seen only by fading sensors"
            f" ({nodes(mode.nodes)}): the second moment of the state grows without bound along it, and so does the"
            " noise that fading makes of it, so in the long run they say nothing about it"
        )
    elif found.growing.shape[1] and found.worst_start is None:
        grows = "; ".join(words(column) for column in found.growing.T)
        fading = np.flatnonzero(found.network.phi(0) > 0)
        said = (
            f"the second moment of the state grows without bound along {grows}, so fading sensors that see any of it"
            f" ({nodes(fading)} fade) say nothing in the long run; the others do not see {weakest}, a direction that"
            " decays by itself: errors stay bounded, but the condition fails"
        )
    elif found.form == "stated" and found.worst_start is None and found.network.phi(0).any():
        said = (
            "the recursion of norms grows without bound, so by it every fading sensor says nothing in the long run;"
            f" the others do not see {weakest}. The sharp form may still hold"
        )
    else:
        said = f"no sensor sees {weakest} within {found.window} instants"
    return replace(found, reason=said)
