"""Steady states, local tolerances and attraction in 50 digits, for any c from 1e-14 to 1e8 and badly scaled states.

Newton's method with a Jacobian of differences. Digits lost to differences, cancellation or scaling come out of a
reserve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpmath import eig, matrix
from numpy import ndarray
from tests.reference import steady_state as naive
from tests.reference.exact import (
    determinant,
    exact,
    eye,
    inverse,
    is_positive,
    log,
    mp,
    mpf,
    rounded,
    size,
    solve,
    trace,
)

RESERVE = 30


@dataclass(frozen=True)
class Exact:
    """A steady state as mpmath numbers."""

    P: ndarray
    V: ndarray
    theta: Any


def kalman(A: ndarray, Q: ndarray, S: ndarray) -> ndarray:
    """P at c = 0: the Riccati recursion from P = 0, each turn doubling the number of its steps (Anderson and Moore).

    Checks its own answer: the equation holds and the closed loop is Schur, which only one P satisfies.
    """
    Phi, G, P, I = A.T, S, Q, eye(len(A))
    for _ in range(200):
        W = inverse(I + G @ P)
        P_next = P + Phi.T @ P @ W @ Phi
        G, Phi, change = G + Phi @ W @ G @ Phi.T, Phi @ W @ Phi, size(P_next - P)
        P = P_next
        if change <= size(P) * mpf(10) ** (10 - mp.dps):
            break
    closed_loop = A @ inverse(I + P @ S)
    if size(P - closed_loop @ P @ A.T - Q) > size(P) * mpf(10) ** (20 - mp.dps):
        raise ArithmeticError("the Riccati equation does not hold")
    if max(abs(np.linalg.eigvals(rounded(closed_loop)))) >= 1:
        raise ArithmeticError("the Riccati solution does not stabilise")
    return (P + P.T) / 2


def steady_state(A: ndarray, Q: ndarray, S: ndarray, c: float, digits: int = 50) -> Exact:
    """The steady state on the path in c from the Kalman filter, for exactly the doubles A, Q and S.

    Starts from the doubles of `tests/reference/steady_state.py` where they reach, else from the Kalman filter.
    ArithmeticError where the path ends before c. S may also be given as mpmath numbers.
    """
    with mp.workdps(digits + RESERVE):
        near = _in_doubles(A, Q, S, min(c, 1e4)) if c > 1e-3 else None
        A, Q, S, I = exact(A), exact(Q), S if S.dtype == object else exact(S), eye(len(A))
        kalmans = kalman(A, Q, S) if near is None else np.array([])
        if c == 0:
            return Exact(kalmans, kalmans, mpf(0))
        goal, here, factor = mpf(c), mpf(0), mpf(100)
        P, theta = (kalmans, mpf(0)) if near is None else near
        ahead = mpf(min(c, 1e-3 if near is None else 1e4))
        while here < goal:
            try:
                start = theta if here or near else mp.sqrt(2 * ahead / trace(P @ P))
                P, theta = newton(A, Q, S, ahead, P, start, digits)
                here, factor = ahead, min(factor * factor, mpf(100))
            except ArithmeticError:
                factor = factor ** mpf(0.25) if here else factor
                if factor < 1 + mpf("1e-6") or ahead < 1e-20:
                    raise ArithmeticError(f"the path ends near c = {mp.nstr(here, 8)}") from None
            ahead = min(goal, here * factor) if here else ahead / 100
        return Exact(P, solve(I - P * theta, P), theta)


def _in_doubles(A: ndarray, Q: ndarray, S: ndarray, c: float) -> tuple[ndarray, Any] | None:
    """None where doubles do not reach: badly scaled, nearly marginal, or past the end of the path."""
    try:
        near = naive.steady_state(A, Q, S if S.dtype == float else rounded(S), c)
    except (RuntimeError, np.linalg.LinAlgError):
        return None
    return exact(near.P), mpf(near.theta)


def newton(A: ndarray, Q: ndarray, S: ndarray, c: Any, P: ndarray, theta: Any, digits: int) -> tuple[ndarray, Any]:
    """Newton's method on P = A P (I + (S - theta I) P)^-1 A' + Q and gamma(P, theta) = c from (P, theta).

    (V^-1 + S = P^-1 + S - theta I, so no inverse of V is needed.) gamma has a pole and a double zero in theta, where
    1 / gamma and sqrt(gamma) are nearly straight. ArithmeticError unless it ends inside theta > 0, theta P < I.
    """
    I, upper = eye(len(A)), np.triu_indices(len(A))
    straight = (lambda x: 1 / x) if c > 1 else mp.sqrt

    def unpack(x: ndarray) -> tuple[ndarray, Any]:
        P = np.array(I)
        P[upper] = P.T[upper] = x[:-1]
        return P, x[-1]

    def equations(x: ndarray) -> ndarray:
        P, theta = unpack(x)
        riccati = P - A @ P @ inverse(I + (S - I * theta) @ P) @ A.T - Q
        return np.append(riccati[upper], straight(gamma(P, theta)) - straight(c))

    x = np.append(P[upper], theta)
    scale = np.sqrt(np.diag(P))
    typical = np.append(np.outer(scale, scale)[upper], theta)
    moved, J = mpf(1), np.array([])
    for _ in range(40):
        f = equations(x)
        if moved > 1e-9:  # afterwards the Jacobian changes no digit that matters
            J = differences(equations, x, f, typical)
        dx = solve(J, -f[:, None])[:, 0]
        while not inside(*unpack(x + dx)):
            dx = dx / 2
            if size(dx / typical) < 1e-20:
                raise ArithmeticError("every step leads outside")
        moved, x = size(dx / typical), x + dx
        if moved < mpf(10) ** -(digits + 5):
            return unpack(x)
    raise ArithmeticError("Newton's method does not settle")


def gamma(P: ndarray, theta: Any) -> Any:
    """log det(I - theta P) + tr((I - theta P)^-1 - I), eq. (4)."""
    I = eye(len(P))
    return log(determinant(I - P * theta)) + trace(inverse(I - P * theta) - I)


def inside(P: ndarray, theta: Any) -> bool:
    """Whether theta > 0 and theta P < I."""
    return theta > 0 and is_positive(eye(len(P)) - P * theta)


def differences(f: Any, x: ndarray, f_x: ndarray, typical: ndarray) -> ndarray:
    """The Jacobian of f at x by forward differences with half of the digits."""
    columns = []
    for j, t in enumerate(typical):
        h = t * mpf(10) ** -(mp.dps // 2)
        ahead = x.copy()
        ahead[j] += h
        columns.append((f(ahead) - f_x) / h)
    return np.stack(columns, axis=1)


def attraction(A: ndarray, Q: ndarray, S: ndarray, c: float, state: Exact) -> float:
    """Spectral radius of the derivative of V_t -> V_{t+1}, eq. (8), by differences of the recursion itself."""
    upper = np.triu_indices(len(A))
    with mp.workdps(80):
        A, Q, S, columns = exact(A), exact(Q), S if S.dtype == object else exact(S), []
        base, scale = advance(A, Q, S, c, state.V, state.theta), np.sqrt(np.diag(state.V))
        typical = np.outer(scale, scale)
        for i, j in zip(*upper, strict=True):
            V, h = state.V.copy(), typical[i, j] * mpf(10) ** -40
            V[i, j] = V[j, i] = V[i, j] + h
            moved = advance(A, Q, S, c, V, state.theta) - base
            columns.append((moved / typical * (typical[i, j] / h))[upper])
        J = matrix(np.stack(columns, axis=1).tolist())  # for large c its entries span as many decades as c
        return float(max(abs(x) for x in eig(J, left=False, right=False)))


def advance(A: ndarray, Q: ndarray, S: ndarray, c: float, V: ndarray, theta: Any) -> ndarray:
    """V_{t+1} from V_t, theta_t found by Newton's method from a value close by."""
    I = eye(len(A))
    P = A @ solve(I + V @ S, V) @ A.T + Q
    for _ in range(4 if c else 0):
        M = inverse(I - P * theta)
        theta = theta - (gamma(P, theta) - mpf(c)) / trace(M @ P @ M - P @ M)
    return solve(I - P * theta, P)


def local_tolerance(A: ndarray, Q: ndarray, C_loc: ndarray, R_loc: ndarray, P: ndarray, V: ndarray) -> Any:
    """c_k of eq. (31) by determinants of size n + p_k, from P_{t+1} and V_t = V_{t+1} of the centre's steady state.

    K_xy K_y^-1 K_yx of the global y in eq. (22) is K_x - P_{t+1} by eq. (19).
    """
    with mp.workdps(110):
        A, Q, C, R = map(exact, (A, Q, C_loc, R_loc))
        P, V = (M if M.dtype == object else exact(M) for M in (P, V))
        K_x, K_xy, K_y = A @ V @ A.T + Q, A @ V @ C.T, C @ V @ C.T + R
        K = np.block([[K_x, K_xy], [K_xy.T, K_y]])
        tilde_K = np.block([[K_x - P + V, K_xy], [K_xy.T, K_y]])
        return log(determinant(K) / determinant(tilde_K)) + trace(solve(K, tilde_K)) - len(K)


def information(C: ndarray, R: ndarray) -> ndarray:
    """C' R^-1 C from the exact values of the doubles."""
    with mp.workdps(80):
        C, R = exact(C), exact(R)
        return C.T @ solve(R, C)
