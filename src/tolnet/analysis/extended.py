"""One filter's steady state in extended precision, for those that doubles cannot decide (docs/mathematics.md, 4.8).

The data are doubles and exact; what rounding takes from the stacked solver (units that span twenty decades, one axis
seen a billion times more precisely than another, chains of integrators) comes out of a reserve of 300 bits. The same
equations, one filter at a time:

1.  S = sum C_l' R_l^-1 C_l over the rows that are heard, Q = B B' where B was given: never through rounded sums
2.  theta = 0, then theta in a bracket: P = A P (I + (S - theta I) P)^-1 A' + Q by doubling
3.  Newton's method on (P, theta) together:  dP - K dP K' - A Z Z A' dtheta = T - P,  d log gamma = log(c / gamma)
4.  past the fold a path in c, by line 3
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy import ndarray

from tolnet.analysis.divergence import inflate, scalar_excess

if TYPE_CHECKING:
    from flint import arb_mat as Matrix
else:
    Matrix = object

BITS = 320
"""Working precision: a double has 53 bits, so that 270 may be lost before six digits are in danger."""
MOST_DOUBLINGS = 96
MOST_SEARCH = 80
MOST_NEWTON = 60
MOST_STRIDES = 1000
MOST_DENSE = 16
"""States up to which equations on symmetric matrices are solved as one dense system, n (n + 1) / 2 square."""
_SETTLED = 2.0**-200  # relative change, in the units of each state, at which doubling and Newton's method stop
_ACCEPT = 2.0**-120  # defect in the units of each state, and of gamma, of what is passed on
_NO_VARIANCE = 2.0**-260
_HAIR = 2.0**-133  # a relative change far below doubles and far above the working precision
_NEAR = 0.05
_FARTHEST = 0.15  # relative change of P from a point between two of the path
_LONGEST = 0.7  # stride of the path: about a doubling of P
_RUN_OFF = 230.0  # growth of log tr P, a hundred decades, after which the path is taken to lead to infinity
_PATH_START = 1e-7


class NoAnswer(Exception):
    """No steady state was found; the text says what ended the search."""


@dataclass(frozen=True)
class Extended:
    """A steady state, rounded to doubles once, at the end."""

    P: Float[ndarray, "n n"]
    V: Float[ndarray, "n n"]
    filtered: Float[ndarray, "n n"]
    """Z = (V^-1 + S)^-1."""
    gain: Float[ndarray, "n m"] | None
    """A Z C' R^-1, where C and R are known."""
    theta: float
    spectral_radius: float
    attraction: float
    riccati_residual: float
    tolerance_residual: float
    iterations: int
    error: float = float(np.finfo(float).eps)
    """What rounding to doubles leaves."""


@dataclass(frozen=True)
class Plant:
    """A, Q and S of one filter as exact or nearly exact matrices; made inside `precision()`."""

    A: Matrix
    Q: Matrix
    S: Matrix
    weighted: Matrix | None = None
    """C' R^-1 of all that is heard, side by side, with S = C' R^-1 C; None where only S is known."""

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.nrows()


def precision() -> Any:
    """The context in which everything here computes."""
    from flint import ctx

    return ctx.workprec(BITS)


def matrix(X: Float[ndarray, "m n"]) -> Matrix:
    """These doubles, exactly."""
    from flint import arb_mat

    return arb_mat(*X.shape, X.ravel().tolist())


def rounded(X: Matrix) -> Float[ndarray, "m n"]:
    """The nearest doubles."""
    values = [float(x.mid()) for x in X.entries()]
    return np.array(values).reshape(X.nrows(), X.ncols())


def noise_covariance(B: Float[ndarray, "n m"] | None, Q: Float[ndarray, "n n"]) -> Matrix:
    """B B' where the factor was given, without its rounding; else Q."""
    if B is None:
        return matrix(Q)
    factor = matrix(B)
    return _middle(factor * factor.transpose())


def information(n: int, sensors: Sequence[tuple[ndarray, ndarray]]) -> tuple[Matrix, Matrix]:
    """S = sum C' R^-1 C over (C, R), and all C' R^-1 side by side."""
    from flint import arb_mat

    S, columns = matrix(np.zeros((n, n))), []
    for C, R in sensors:
        if len(C):
            Y = matrix(C)
            weighted = _solve(matrix(R), Y)
            S = S + Y.transpose() * weighted
            columns += weighted.tolist()
    return _symmetric(S), arb_mat(columns).transpose() if columns else arb_mat(n, 0)


def solve_extended(
    plant: Plant,
    c: float,
    *,
    near: tuple[Float[ndarray, "n n"], float] | None = None,
    undriven: bool = False,
    only_near: bool = False,
) -> tuple[Extended, Matrix, Matrix]:
    """The steady state at tolerance c, gamma scale, with its P and V before rounding.

    `near` is a guess (P, theta) in doubles, `only_near` tries no other start. `undriven` says that modes outside the unit circle are not driven, so that
    the stabilising solution is not the one that is reached from P = 0. Raises NoAnswer. Kullback-Leibler balls only.
    Assumes detectability, and no undriven mode on the unit circle.
    """
    count = _Count()
    if near is not None:
        try:
            return _finish(plant, c, *_newton(plant, c, matrix(near[0]), _number(near[1]), count), count)
        except (NoAnswer, ZeroDivisionError) as end:
            if only_near:
                raise NoAnswer(str(end)) from None
    try:
        P, theta = _from_kalman(plant, c, undriven, count)
    except ZeroDivisionError:
        raise NoAnswer("a matrix of the recursion is singular") from None
    return _finish(plant, c, P, theta, count)


def seen_tolerance(plant: Plant, P: Matrix, V: Matrix) -> float:
    """c_k = tr(P_k^-1 X) - log det(I + P_k^-1 X), X = V - P, of eqs. (30), (42): from the centre's P, V and the node's S.

    P_k is singular where P is, in directions in which X is zero: a hair is added to it there. NaN where that fails.
    """
    n, A = plant.n, plant.A
    local = _symmetric(A * _solve(_identity(n) + V * plant.S, V) * A.transpose() + plant.Q)
    for i in range(n):
        local[i, i] += local[i, i] * _HAIR if local[i, i] > 0 else _number(1)
    X = _symmetric(V - P)
    before, after = _pivots(local), _pivots(local + X)
    if before is None or after is None:
        return math.nan
    logarithm = sum(((b / a).log() for a, b in zip(before, after, strict=True)), _number(0))
    return float((_solve(local, X).trace() - logarithm).mid())


class _Count:
    """Doubling solves and Newton steps so far."""

    total = 0


def _from_kalman(plant: Plant, c: float, undriven: bool, count: _Count) -> tuple[Matrix, Any]:
    """Lines 2 to 4, from the Kalman filter's P."""
    start = _identity(plant.n) if undriven else None
    kalman = _doubling(plant, _number(0), start, count)
    if c == 0:
        return kalman, _number(0)
    if not rounded(kalman).any():
        raise NoAnswer("without process noise the covariance falls to zero")
    P, theta, reached = _search(plant, c, kalman, start, count)
    if reached == c:
        return P, theta
    try:
        return _newton(plant, c, P, theta, count)
    except (NoAnswer, ZeroDivisionError):
        return _follow(plant, c, P, theta, reached, count)


def _search(plant: Plant, c: float, kalman: Matrix, start: Matrix | None, count: _Count) -> tuple[Matrix, Any, float]:
    """A steady state at fixed theta whose gamma is near c, or the largest found below: the search of `continuation`."""
    wanted, values = _phi(c), np.linalg.eigvalsh(rounded(kalman))
    low, high = 0.0, float(inflate(np.maximum(values, 0.0)[None], np.array([c])).theta[0])
    P, at, reached = kalman, 0.0, 0.0
    before, psi_before = 0.0, 1.0 / float(np.linalg.norm(rounded(kalman)))
    theta = min(wanted * psi_before, high)
    for _ in range(MOST_SEARCH):
        try:
            solution = _doubling(plant, _number(theta), start, count)
            value = float(_gamma(solution, _number(theta))[0].mid())
        except (NoAnswer, ZeroDivisionError):
            solution, value = kalman, math.inf
        phi = _phi(value)
        near = math.isfinite(value) and abs(phi / wanted - 1) < _NEAR and abs(math.log(value / c)) < _NEAR**0.5
        if near or reached < value < c:
            P, at, reached = solution, theta, value
        if near:
            break
        low, high = (max(low, theta), high) if value < c else (low, min(high, theta))
        middle = (low + high) / 2
        if math.isfinite(value) and theta != before:
            psi = theta / phi
            rise = (psi - psi_before) / (theta - before)
            before, psi_before = theta, psi
            bend = 1 / wanted - rise
            secant = (psi - rise * theta) / bend if bend else middle
            theta = secant if low < secant < high else middle
        else:
            theta = middle
        if high - low <= 1e-9 * high:
            break
    return P, _number(at), reached


def _phi(value: float) -> float:
    """s with gamma(1, s) = value, 1 where that is infinite."""
    if not math.isfinite(value):
        return 1.0
    excess = float(scalar_excess(np.array([value]))[0])
    return excess / (1 + excess)


def _follow(plant: Plant, c: float, P: Matrix, theta: Any, reached: float, count: _Count) -> tuple[Matrix, Any]:
    """Line 4: strides along the curve (P, theta, log c) of steady states, until log c has come to its goal.

    The length of a stride counts P in the units of its states and log c; theta follows. So the path goes round turning
    points in theta and in c, and through the narrow ranges of c in which P grows by many decades.
    """
    n, goal = plant.n, math.log(c)
    if n > MOST_DENSE:
        raise NoAnswer(f"beyond the fold filters of up to {MOST_DENSE} states are followed")
    if reached == 0:
        reached = min(_PATH_START, c)
        theta = _number(math.sqrt(2 * reached) / float(np.linalg.norm(rounded(P))))
    P, theta = _newton(plant, reached, P, theta, count)
    first, at, stride = P.trace(), _number(reached).log(), 0.25
    tangent = _Direction(_zeros(n), _number(0), _number(1))
    for _ in range(MOST_STRIDES):
        system = _Bordered.at(plant, P, theta, at, tangent)
        ahead = system.solve(_zeros(n), _number(0), _number(1))
        tangent = ahead.over(ahead.norm(system.units))
        while True:
            there = _correct(plant, P, theta, at, tangent, stride, count)
            if there is not None:
                break
            stride /= 3
            if stride < 1e-9:
                raise NoAnswer(f"the path of steady states ends at c = {float(at.exp()):.6g}")
        if float(there[2]) >= goal:
            share = (_number(goal) - at) / (there[2] - at)
            between = (_middle(P + (there[0] - P) * share), (theta + (there[1] - theta) * share).mid())
            try:
                last = _newton(plant, c, *between, count)
                if _distance(between[0], last[0]) <= _FARTHEST:
                    return last
            except (NoAnswer, ZeroDivisionError):
                pass
            if stride < 1e-6:
                raise NoAnswer("the path of steady states passes c too steeply to stop at it")
            stride /= 5  # the same stretch again, in smaller strides
            continue
        P, theta, at = there
        if float((P.trace() / first).log()) > _RUN_OFF:
            raise NoAnswer(f"the steady states grow without bound before c = {float(at.exp()):.6g}")
        stride = min(1.6 * stride, _LONGEST)
    raise NoAnswer(f"the path in c came to {float(at.exp()):.6g} in {MOST_STRIDES} strides")


def _correct(
    plant: Plant, P: Matrix, theta: Any, at: Any, tangent: _Direction, stride: float, count: _Count
) -> tuple[Matrix, Any, Any] | None:
    """The steady state a stride ahead, by Newton's method across the tangent; None where it does not settle nearby."""
    move = tangent.over(1 / _number(stride))
    goal = (_middle(P + move.P), theta + move.theta, at + move.log_c)
    there, moved = goal, math.inf
    try:
        for turn in range(8):
            count.total += 1
            system = _Bordered.at(plant, *there, tangent)
            step = system.solve(*system.defects(), _number(0))
            there = (_middle(there[0] + step.P), (there[1] + step.theta).mid(), (there[2] + step.log_c).mid())
            moved = float(step.norm(system.units))
            if not moved < 0.5 * stride:
                return None
            if moved < 1e-12:
                return there if there[1] > 0 else None
    except (NoAnswer, ZeroDivisionError):
        pass
    return None


@dataclass(frozen=True)
class _Direction:
    """A change of (P, theta, log c)."""

    P: Matrix
    theta: Any
    log_c: Any

    def over(self, size: Any) -> _Direction:
        """This direction divided by a number."""
        return _Direction(_middle(self.P / size), (self.theta / size).mid(), (self.log_c / size).mid())

    def norm(self, units: Matrix) -> Any:
        """Of P in these units and of log c together."""
        n = units.nrows()
        parts = [(self.P[i, j] * units[i, j]) ** 2 for i in range(n) for j in range(n)]
        return (sum(parts, self.log_c**2)).sqrt().mid()


@dataclass(frozen=True)
class _Bordered:
    """The equations of a steady state at an open c, linearised, with the direction that is left free as last row."""

    matrix: Matrix
    units: Matrix
    """1 / sqrt(P_ii P_jj)."""
    defect: Matrix
    mismatch: Any

    @classmethod
    def at(cls, plant: Plant, P: Matrix, theta: Any, log_c: Any, tangent: _Direction) -> _Bordered:
        """Rows: dP - K dP K' - thrust dtheta; d log gamma - d log c; the component along the tangent."""
        from flint import arb_mat

        following, Z = _step(plant, P, theta)
        gamma, M = _gamma(P, theta)
        slope = Slope.at(plant, P, theta, Z, M)
        upper = _upper(plant.n)
        units = _units(P)
        rows = [
            [(1 if a == b else 0) - x for b, x in enumerate(row)] + [-slope.thrust[i, j], _number(0)]
            for a, ((i, j), row) in enumerate(zip(upper, slope.operator(), strict=True))
        ]
        twice = [1 if i == j else 2 for i, j in upper]
        pull = [theta * m * slope.pull[i, j] / gamma for m, (i, j) in zip(twice, upper, strict=True)]
        rows.append([*pull, (slope.pull * P).trace() / gamma, _number(-1)])
        along = [m * tangent.P[i, j] * units[i, j] ** 2 for m, (i, j) in zip(twice, upper, strict=True)]
        rows.append([*along, _number(0), tangent.log_c])
        return cls(_middle(arb_mat(rows)), units, following - P, log_c - gamma.log())

    def defects(self) -> tuple[Matrix, Any]:
        """What is missing in the two equations."""
        return self.defect, self.mismatch

    def solve(self, defect: Matrix, mismatch: Any, along: Any) -> _Direction:
        """The direction with these right-hand sides."""
        from flint import arb_mat

        n = self.units.nrows()
        right = [[defect[i, j]] for i, j in _upper(n)] + [[mismatch], [along]]
        x = _solve(self.matrix, arb_mat(right))
        d = len(right) - 2
        return _Direction(_unpacked(x, 0, n), x[d, 0], x[d + 1, 0])


def _upper(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def _unpacked(x: Matrix, column: int, n: int) -> Matrix:
    """The symmetric matrix whose upper triangle is a column of x."""
    X = _zeros(n)
    for row, (i, j) in enumerate(_upper(n)):
        X[i, j] = X[j, i] = x[row, column]
    return X


def _units(P: Matrix) -> Matrix:
    """1 / sqrt(P_ii P_jj); 1 for a state without variance."""
    from flint import arb_mat

    root = [x.sqrt() if x > 0 else _number(1) for x in (P[i, i].mid() for i in range(P.nrows()))]
    return _middle(arb_mat([[1 / (a * b) for b in root] for a in root]))


def _doubling(plant: Plant, theta: Any, start: Matrix | None, count: _Count) -> Matrix:
    """P = A P (I + G P)^-1 A' + Q with G = S - theta I, the limit of the recursion from `start` (zero without one).

    A start P_0 is a change of the unknown, X = P - P_0:  X = F X (I + (W G) X)^-1 F' + (A W'P_0 A' + Q - P_0),
    W = (I + G P_0)^-1, F = A W'.
    """
    n, eye = plant.n, _identity(plant.n)
    G = plant.S - eye * theta
    Aj, Gj, Hj = plant.A.transpose(), G, plant.Q
    if start is not None:
        W = _solve(eye + G * start, eye)
        Aj = W * Aj
        Hj = _symmetric(plant.A * W.transpose() * start * plant.A.transpose() + plant.Q - start)
        Gj = _symmetric(W * G)
    for _ in range(MOST_DOUBLINGS):
        count.total += 1
        inner = eye + Gj * Hj
        WA, WG = _solve(inner, Aj), _solve(inner, Gj)
        growth = _symmetric(Aj.transpose() * Hj * WA)
        Gj = _symmetric(Gj + Aj * WG * Aj.transpose())
        Hj = _middle(Hj + growth)
        Aj = _middle(Aj * WA)
        total = Hj if start is None else Hj + start
        if _distance(total, total - growth) <= _SETTLED:
            P = _symmetric(total)
            if _distance(P, _step(plant, P, theta)[0]) > _ACCEPT:
                raise NoAnswer("doubling lost its digits")
            _check_covariance(P)
            return P
        if not all(x.is_finite() for x in Hj.entries()):
            break
    raise NoAnswer(f"doubling did not settle in {MOST_DOUBLINGS} turns")


def _step(plant: Plant, P: Matrix, theta: Any) -> tuple[Matrix, Matrix]:
    """A Z A' + Q and Z = P (I + (S - theta I) P)^-1."""
    eye = _identity(plant.n)
    Z = _symmetric(_solve(eye + P * (plant.S - eye * theta), P))
    return _symmetric(plant.A * Z * plant.A.transpose() + plant.Q), Z


def _gamma(P: Matrix, theta: Any) -> tuple[Any, Matrix]:
    """gamma(P, theta) and M = (I - theta P)^-1. Raises NoAnswer unless theta P < I and P >= 0."""
    eye = _identity(P.nrows())
    inner = eye - P * theta
    pivots = _pivots(inner)
    if pivots is None:
        raise NoAnswer("theta is beyond 1 / lambda_max(P)")
    M = _symmetric(_solve(inner, eye))
    return (sum((x.log() for x in pivots), M.trace()) - P.nrows()).mid(), M


def _newton(
    plant: Plant, c: float, P: Matrix, theta: Any, count: _Count, most: int = MOST_NEWTON
) -> tuple[Matrix, Any]:
    """Line 3, halving steps that leave theta > 0, theta P < I. At c = 0 on P alone."""
    goal = _number(c)
    gamma, M = _gamma(P, theta)
    moved = math.inf
    for _ in range(most):
        count.total += 1
        following, Z = _step(plant, P, theta)
        defect = following - P
        slope = Slope.at(plant, P, theta, Z, M)
        X, Y = slope.resolve(defect)
        if c == 0:
            dtheta = _number(0)
        else:
            # gamma_P dP + gamma_theta dtheta = gamma log(c / gamma)
            wanted = gamma * (goal / gamma).log()
            pull = slope.pull
            dtheta = (wanted - theta * (pull * X).trace()) / ((pull * P).trace() + theta * (pull * Y).trace())
        dP = _symmetric(X + Y * dtheta)
        share = _number(1)
        for _ in range(60):
            try:
                there, theta_there = _middle(P + dP * share), (theta + dtheta * share).mid()
                if c > 0 and not theta_there > 0:
                    raise NoAnswer("theta is not positive")
                gamma, M = _gamma(there, theta_there)
                break
            except NoAnswer:
                share = share / 2
        else:
            raise NoAnswer("every step of Newton's method leaves the covariances")
        moved, P, theta = _distance(there, P), there, theta_there
        if moved <= _SETTLED:
            break
    accept(plant, c, P, theta)
    return P, theta


def accept(plant: Plant, c: float, P: Matrix, theta: Any) -> tuple[float, float]:
    """The two residuals of a steady state. Raises NoAnswer unless they are tiny and P >= 0."""
    riccati = _distance(P, _step(plant, P, theta)[0])
    mismatch = 0.0 if c == 0 else abs(float((_gamma(P, theta)[0] / _number(c) - 1).mid()))
    if not (riccati <= _ACCEPT and mismatch <= _ACCEPT):
        raise NoAnswer(f"Newton's method did not settle in {MOST_NEWTON} steps")
    _check_covariance(P)
    return riccati, mismatch


def _check_covariance(P: Matrix) -> None:
    """Raises NoAnswer for a P with a negative eigenvalue; what is smaller than rounding is a singular P."""
    units, n = _units(P), P.nrows()
    unit = np.array([[float((P[i, j] * units[i, j]).mid()) for j in range(n)] for i in range(n)])
    if not np.linalg.eigvalsh(unit)[0] >= -4 * n * np.finfo(float).eps:
        raise NoAnswer("the solution of the equations is no covariance")


@dataclass(frozen=True)
class Slope:
    """The derivative of the recursion at (P, theta): K dP K' + thrust dtheta, and that of gamma, theta pull dP + ..."""

    K: Matrix
    """A Z P^-1 = A (I + P (S - theta I))^-1."""
    thrust: Matrix
    """A Z Z A'."""
    pull: Matrix
    """M^2 - M: d gamma = tr(pull (theta dP + P dtheta))."""

    @classmethod
    def at(cls, plant: Plant, P: Matrix, theta: Any, Z: Matrix, M: Matrix) -> Slope:
        """From Z = (V^-1 + S)^-1 and M = (I - theta P)^-1."""
        eye = _identity(plant.n)
        K = plant.A * _solve(eye + P * (plant.S - eye * theta), eye)
        AZ = plant.A * Z
        return cls(_middle(K), _symmetric(AZ * AZ.transpose()), _symmetric(M * M - M))

    def operator(self) -> list[list[Any]]:
        """dP -> K dP K' as a matrix on upper triangles."""
        K, upper = self.K.tolist(), _upper(self.K.nrows())
        return [
            [K[i][k] * K[j][l] if k == l else K[i][k] * K[j][l] + K[i][l] * K[j][k] for k, l in upper]
            for i, j in upper
        ]

    def resolve(self, defect: Matrix) -> tuple[Matrix, Matrix]:
        """X and Y with X - K X K' = defect, Y - K Y K' = thrust."""
        from flint import arb_mat

        n = self.K.nrows()
        if n > MOST_DENSE:
            return self._doubled(defect), self._doubled(self.thrust)
        rows = [[(1 if a == b else 0) - x for b, x in enumerate(row)] for a, row in enumerate(self.operator())]
        right = [[defect[i, j], self.thrust[i, j]] for i, j in _upper(n)]
        solution = _solve(arb_mat(rows), arb_mat(right))
        return _unpacked(solution, 0, n), _unpacked(solution, 1, n)

    def _doubled(self, right: Matrix) -> Matrix:
        """sum_t K^t right K'^t by squaring (Smith's method), for a Schur K."""
        X, power = right, self.K
        for _ in range(MOST_DOUBLINGS):
            growth = power * X * power.transpose()
            X, power = _symmetric(X + growth), _middle(power * power)
            if max((abs(x) for x in power.entries()), default=0) < _SETTLED:
                return X
        raise NoAnswer(f"the loop at fixed theta does not decay in 2^{MOST_DOUBLINGS} steps")


def _finish(plant: Plant, c: float, P: Matrix, theta: Any, count: _Count) -> tuple[Extended, Matrix, Matrix]:
    """Everything that a steady state holds, each rounded once."""
    riccati, mismatch = accept(plant, c, P, theta)
    eye = _identity(plant.n)
    _, M = _gamma(P, theta)
    V = _symmetric(P * M)
    _, Z = _step(plant, P, theta)
    loop = plant.A * _solve(eye + V * plant.S, eye)  # A Z V^-1
    radius = _radius(loop)
    if c == 0 and not radius < 1:
        raise NoAnswer("rounding hides whether the Riccati solution stabilises")
    slope = Slope.at(plant, P, theta, Z, M)
    state = Extended(
        P=rounded(P),
        V=rounded(V),
        filtered=rounded(Z),
        gain=None if plant.weighted is None else rounded(plant.A * Z * plant.weighted),
        theta=float(theta),
        spectral_radius=radius,
        attraction=_attraction(slope, P, theta),
        riccati_residual=riccati,
        tolerance_residual=mismatch,
        iterations=count.total,
    )
    return state, P, V


def _radius(F: Matrix) -> float:
    """Spectral radius, from eigenvalues in the working precision."""
    from flint import acb_mat

    values = acb_mat(_middle(F)).eig(algorithm="approx")
    return max(float(abs(x).mid()) for x in values)


def _attraction(slope: Slope, P: Matrix, theta: Any) -> float:
    """Spectral radius of dP -> K dP K' + thrust dtheta with dtheta = -theta tr(pull dP) / tr(pull P).

    In the units of P, where doubles usually do: eigenvalues come with their condition number.
    """
    from flint import arb_mat

    n, units, upper = P.nrows(), _units(P), _upper(P.nrows())
    weight = (slope.pull * P).trace()
    factor = theta / weight if theta > 0 else _number(0)
    pull = [factor * (1 if k == l else 2) * slope.pull[k, l] for k, l in upper]
    rows = [
        [(x - slope.thrust[i, j] * a) * units[i, j] / units[k, l] for x, a, (k, l) in zip(row, pull, upper, strict=True)]
        for (i, j), row in zip(upper, slope.operator(), strict=True)
    ]
    whole = _middle(arb_mat(rows))
    radius, error = radius_with_error(rounded(whole))
    return _radius(whole) if error > 1e-9 * radius and n <= MOST_DENSE else radius


def radius_with_error(F: Float[ndarray, "d d"]) -> tuple[float, float]:
    """Spectral radius, and what rounding may do to it: d eps |F| / |y* x| for unit left and right eigenvectors y, x."""
    values, left, right = scipy.linalg.eig(F, left=True, right=True)
    largest = int(np.abs(values).argmax())
    overlap = abs(np.vdot(left[:, largest], right[:, largest]))
    rounding = len(F) * np.finfo(float).eps * float(np.linalg.norm(F))
    return float(abs(values[largest])), rounding / overlap if overlap > 0 else math.inf


def _distance(X: Matrix, Y: Matrix) -> float:
    """max |X_ij - Y_ij| / sqrt(X_ii X_jj): a change in the units of each state.

    A variance below 2^-260 of the largest, beyond the range of units, is none: a state that is known exactly.
    """
    n = X.nrows()
    variances = [abs(X[i, i].mid()) for i in range(n)]
    least = max(variances) * _NO_VARIANCE
    scale = [max(x, least).sqrt() for x in variances]
    worst = 0.0
    for i in range(n):
        for j in range(i, n):
            gap = abs((X[i, j] - Y[i, j]).mid())
            if gap != 0:
                size = scale[i] * scale[j]
                worst = max(worst, float((gap / size).mid()) if size > 0 else math.inf)
    return worst if not math.isnan(worst) else math.inf


def _pivots(X: Matrix) -> list[Any] | None:
    """Of an elimination without exchanges in a symmetric matrix; None unless all are positive: X is then definite."""
    n = X.nrows()
    rest = [[X[i, j].mid() for j in range(n)] for i in range(n)]
    for k in range(n):
        if not rest[k][k] > 0:
            return None
        for i in range(k + 1, n):
            share = (rest[i][k] / rest[k][k]).mid()
            for j in range(k + 1, i + 1):
                rest[i][j] = rest[j][i] = (rest[i][j] - share * rest[k][j]).mid()
    return [rest[k][k] for k in range(n)]


def _number(x: float | int) -> Any:
    from flint import arb

    return arb(x)


def _identity(n: int) -> Matrix:
    return matrix(np.eye(n))


def _zeros(n: int) -> Matrix:
    return matrix(np.zeros((n, n)))


def _solve(X: Matrix, Y: Matrix) -> Matrix:
    """X^-1 Y without error bounds; ZeroDivisionError where X is singular."""
    return X.solve(Y, algorithm="approx")


def _middle(X: Matrix) -> Matrix:
    """Without the radii, which only grow here."""
    return X.mid()


def _symmetric(X: Matrix) -> Matrix:
    return ((X + X.transpose()) / 2).mid()
