"""Certificates of tiny networks, made the naive way: candidates from dense NumPy, nothing clever, nothing shared.

docs/certificate.md is all that this file and `tolnet.certificates.check` have in common.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

Document = dict[str, Any]


def text(array: Any) -> str:
    """Row by row, as float.hex writes doubles."""
    return " ".join(float(x).hex() for x in np.ravel(np.asarray(array, dtype=float)))


def triangle(S: Any) -> str:
    """The upper triangle, row by row."""
    S = np.asarray(S, dtype=float)
    return " ".join(float(S[i, j]).hex() for i in range(len(S)) for j in range(i, len(S)))


def document(data: Document, *claims: Document) -> Document:
    """A whole certificate."""
    return {
        "schema": "tolnet.certificate/1",
        "tolnet": "0.1.0",
        "problem": {"name": "tiny", "sha256": "0" * 64},
        "convention": "gamma",
        "tau": 0.0,
        "tolerance": 0.02,
        "status": "ok",
        "data": data,
        "claims": list(claims),
    }


def scalar_data(a: float, w: float = 1.0) -> Document:
    """One relay with one state: F = [w a]."""
    return {
        "n": 1,
        "nodes": 1,
        "A": text([a]),
        "process": {"Q": text([1.0])},
        "C": [""],
        "noise": [{}],
        "directed": False,
        "neighbours": [[0]],
        "weights": [text([w])],
        "gains": [""],
        "centre": None,
    }


def ring(nodes: int) -> list[list[int]]:
    """Who hears whom on a ring, both ways."""
    return [sorted({k, (k + 1) % nodes, (k - 1) % nodes}) for k in range(nodes)]


def path(nodes: int) -> list[list[int]]:
    """Who hears whom on a path."""
    return [[l for l in (k - 1, k, k + 1) if 0 <= l < nodes] for k in range(nodes)]


def one_way(nodes: int) -> list[list[int]]:
    """Every node hears the one before it, round a ring."""
    return [sorted({k, (k - 1) % nodes}) for k in range(nodes)]


def random_data(
    rng: np.random.Generator,
    n: int,
    neighbours: list[list[int]],
    *,
    directed: bool = False,
    radius: float = 0.9,
    relays: tuple[int, ...] = (),
    negative: bool = False,
    columns: int = 1,
    tilt: float = 0.05,
    factors: bool = False,
) -> Document:
    """A random network with Kalman gains and a random (small) tilt."""
    nodes = len(neighbours)
    A = rng.normal(size=(n, n))
    A *= radius / max(abs(np.linalg.eigvals(A)))
    C = [np.zeros((0, n)) if k in relays else rng.normal(size=(1 + k % 2, n)) for k in range(nodes)]
    D = [np.eye(len(c)) + 0.2 * rng.normal(size=(len(c), len(c))) for c in C]
    R = [0.5 * (d @ d.T + (d @ d.T).T) for d in D]
    B = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    Q = B @ B.T
    Q = 0.5 * (Q + Q.T)

    def gain(sensors: list[int]) -> ndarray:
        H = np.vstack([C[l] for l in sensors])
        if not len(H):
            return np.zeros((n, 0))
        S = np.zeros((len(H), len(H)))
        at = 0
        for l in sensors:
            S[at : at + len(R[l]), at : at + len(R[l])] = R[l]
            at += len(R[l])
        P = solve_discrete_are(A.T, H.T, Q, S)
        return A @ P @ H.T @ np.linalg.inv(H @ P @ H.T + S)

    central = gain(list(range(nodes)))
    offsets = np.cumsum([0] + [len(c) for c in C])
    weights = []
    for heard in neighbours:
        w = rng.uniform(0.2, 1.0, len(heard))
        if negative and len(w) > 1:
            w[-1] = -0.1
        weights.append(w / w.sum())
    return {
        "n": n,
        "nodes": nodes,
        "A": text(A),
        "process": {"B": text(B), "columns": n} if factors else {"Q": text(Q)},
        "C": [text(c) for c in C],
        "noise": [
            {} if not len(d) else {"D": text(d)} if factors else {"R": text(r)} for d, r in zip(D, R, strict=True)
        ],
        "directed": directed,
        "neighbours": neighbours,
        "weights": [text(w) for w in weights],
        "gains": [text(gain(heard)) for heard in neighbours],
        "centre": {
            "gain": [text(central[:, offsets[l] : offsets[l + 1]]) for l in range(nodes)],
            "tilt": text(tilt * rng.normal(size=(n, columns))),
            "columns": columns,
        },
    }


class Numbers:
    """What follows from the numbers of `data`: in doubles for candidates, in fractions for the truth."""

    def __init__(self, data: Document, number: Callable[[float], Any] = float) -> None:
        def read(words: str, *shape: int) -> ndarray:
            values = np.array([number(float.fromhex(word)) for word in words.split()], dtype=self.dtype)
            return values.reshape(shape)

        self.dtype = float if number is float else object
        n, N = self.n, self.N = data["n"], data["nodes"]
        self.neighbours, self.directed = data["neighbours"], data["directed"]
        self.A = read(data["A"], n, n)
        self.C = [read(c, -1, n) if c else self.zeros(0, n) for c in data["C"]]
        self.R = []
        for given, C in zip(data["noise"], self.C, strict=True):
            p = len(C)
            D = read(given["D"], p, p) if "D" in given else None
            self.R.append(D @ D.T if D is not None else read(given.get("R", ""), p, p))
        if "Q" in data["process"]:
            self.Q = read(data["process"]["Q"], n, n)
        else:
            B = read(data["process"]["B"], n, data["process"]["columns"])
            self.Q = B @ B.T
        self.W = self.weights(data["weights"], read)
        self.G = self.gains(data["gains"], read)  # G[k][l]
        self.M = self.loops(self.G)
        self.network = self.block(self.W, self.M)
        self.read = read
        if data["centre"] is not None:
            self.Gc = [read(g, n, len(self.C[l])) for l, g in enumerate(data["centre"]["gain"])]
            Y = read(data["centre"]["tilt"], n, data["centre"]["columns"])
            self.T = Y @ Y.T if Y.size else self.zeros(n, n)
            self.F0 = self.A - self.total(n, [self.Gc[l] @ self.C[l] for l in self.sensors(range(N))])
            self.Nc = self.Q + self.total(n, [self.Gc[l] @ self.R[l] @ self.Gc[l].T for l in self.sensors(range(N))])
            self.Fe = self.F0 + self.Nc @ self.T @ self.F0

    def zeros(self, *shape: int) -> ndarray:
        """Zeros of the right kind."""
        return np.full(shape, 0, dtype=self.dtype)

    def total(self, n: int, terms: list[ndarray]) -> ndarray:
        """The sum of matrices n x n."""
        return sum(terms, self.zeros(n, n))

    def sensors(self, nodes: Any) -> list[int]:
        """Those of the nodes that are no relays."""
        return [l for l in nodes if len(self.C[l])]

    def weights(self, texts: list[str], read: Any) -> ndarray:
        """W, column k for node k."""
        W = self.zeros(self.N, self.N)
        for k, heard in enumerate(self.neighbours):
            W[heard, k] = read(texts[k], len(heard))
        return W

    def gains(self, texts: list[str], read: Any) -> list[dict[int, ndarray]]:
        """G[k][l]."""
        found = []
        for k, heard in enumerate(self.neighbours):
            G = read(texts[k], self.n, sum(len(self.C[l]) for l in heard))
            cuts = np.cumsum([len(self.C[l]) for l in heard])[:-1]
            found.append(dict(zip(heard, np.split(G, cuts, axis=1), strict=True)))
        return found

    def loops(self, G: list[dict[int, ndarray]]) -> list[ndarray]:
        """M_k = A - sum_l G_{k,l} C_l."""
        return [self.A - self.total(self.n, [g[l] @ self.C[l] for l in self.sensors(g)]) for g in G]

    def block(self, W: ndarray, M: list[ndarray]) -> ndarray:
        """The network block: w_lk M_l at (k, l)."""
        return np.block([[W[l, k] * M[l] for l in range(self.N)] for k in range(self.N)])

    @property
    def sigma(self) -> ndarray:
        """sum_l |w_lk|."""
        return abs(self.W).sum(axis=0)

    def whole(self) -> tuple[ndarray, ndarray, list[ndarray]]:
        """F, G G', and the coupling blocks C_k of F."""
        n, N, total = self.n, self.N, self.total
        maps = [*self.G, dict(enumerate(self.Gc))]
        E = [self.Q + total(n, [G[l] @ self.R[l] @ self.Gc[l].T for l in self.sensors(G)]) for G in maps]
        one = self.zeros(1, 1) + 1
        U = np.block([[self.W.T, self.zeros(N, 1)], [self.zeros(1, N), one]])
        U = np.kron(U, np.eye(n, dtype=int).astype(self.dtype))
        F = self.zeros((N + 1) * n, (N + 1) * n)
        for k in range(N):
            F[k * n : (k + 1) * n, k * n : (k + 1) * n] = self.M[k]
            F[k * n : (k + 1) * n, N * n :] = E[k] @ self.T @ self.F0
        F[N * n :, N * n :] = self.Fe
        noise = np.block(
            [
                [
                    self.Q
                    + total(n, [a[j] @ self.R[j] @ b[j].T for j in self.sensors(a) if j in b])
                    + E[k] @ self.T @ E[l].T
                    for l, b in enumerate(maps)
                ]
                for k, a in enumerate(maps)
            ]
        )
        F = U @ F
        return F, U @ noise @ U.T, [F[k * n : (k + 1) * n, N * n :] for k in range(N)]


BLOCKS = {
    "F": "the network's error dynamics F under the stated least favourable model",
    "network": "the network block of the error dynamics",
}


def said_stable(block: str, rate: float | None = None) -> str:
    """The statement of a proved `schur-stability`, or of `decay-rate`."""
    where = "unit circle: errors die out." if rate is None else f"circle of radius {rate!r}."
    return f"With the stated weights and constant gains, every eigenvalue of {BLOCKS[block]} lies inside the {where}"


def said_unstable(which: str = "network") -> str:
    """Of a refuted `schur-stability`."""
    return (
        f"With the stated weights and constant gains, some eigenvalue of the {which} block of the error dynamics "
        "lies outside the unit circle: errors grow."
    )


def said_switching(claim: Document) -> str:
    """Of `switching`, by its keys."""
    if "drop" in claim:
        how = f"links drop and return, at most {claim['drop']} at once, each losing estimate and measurement together"
    else:
        alternate = f"the nominal network and {len(claim['scenarios'])} scenarios alternate"
        how = f"{alternate} (a link that drops loses both estimate and measurement)"
    return f"With constant gains in each state, the network block of the error dynamics stays stable however {how}."


def said_performance(low: float, high: float) -> str:
    """Of `performance`."""
    return (
        "With the stated weights and constant gains, under the stated least favourable model, the steady mean square "
        f"deviation of the network lies in [{low!r}, {high!r}], and that of every node in its interval."
    )


def _claim(name: str, statement: str, margin: float | None, **own: Any) -> Document:
    return {"claim": name, "verdict": "proved", "statement": statement, "margin": margin, "reason": None, **own}


def stability_claim(
    data: Document, method: str, *, block: str = "network", rate: float | None = None, share_of_slack: float = 0.5
) -> Document:
    """A proved `schur-stability` (or, with a rate, `decay-rate`), by this method; the margin is part of the slack."""
    at, r = Numbers(data), 1.0 if rate is None else rate
    n, N = at.n, at.N
    proof: Document = {"method": method}
    if method in ("primal", "dual"):
        X, image = [np.eye(n)] * N, [np.eye(n)] * N
        for _ in range(2000):
            if method == "primal":
                moved = [M @ x @ M.T / r**2 for M, x in zip(at.M, X, strict=True)]
                image = [at.sigma[k] * sum(abs(at.W[l, k]) * moved[l] for l in range(N)) for k in range(N)]
            else:
                image = [
                    at.M[l].T @ sum(at.sigma[k] * abs(at.W[l, k]) * X[k] for k in range(N)) @ at.M[l] / r**2
                    for l in range(N)
                ]
            X = [0.5 * (x + x.T) + np.eye(n) for x in image]
        proof["X" if method == "primal" else "Y"] = [triangle(x) for x in X]
        slack = _slack(X, image)
    elif method == "power":
        j = proof["power"] = 2
        power = np.linalg.matrix_power(at.network, j)
        reach = np.linalg.matrix_power((at.W != 0).astype(int), j)  # of W: column k, row l
        blocks = {(k, l): power[k * n : (k + 1) * n, l * n : (l + 1) * n] for k in range(N) for l in range(N)}
        shares = []
        for k in range(N):
            norms = np.array([np.linalg.norm(blocks[k, l]) + 1e-3 for l in range(N) if reach[l, k]])
            shares.append((1 - 1e-12) * norms / norms.sum())
        X, image = [np.eye(n)] * N, [np.eye(n)] * N
        for _ in range(2000):
            image = []
            for k in range(N):
                reached = [l for l in range(N) if reach[l, k]]
                image.append(
                    sum(
                        blocks[k, l] @ X[l] @ blocks[k, l].T / (p * r ** (2 * j))
                        for l, p in zip(reached, shares[k], strict=True)
                    )
                )
            X = [0.5 * (x + x.T) + np.eye(n) for x in image]
        proof |= {"X": [triangle(x) for x in X], "shares": [text(p) for p in shares]}
        slack = _slack(X, image)
    else:
        X = solve_discrete_lyapunov(at.network / r, np.eye(N * n))
        proof["X"] = triangle(X)
        slack = _slack([X], [at.network @ X @ at.network.T / r**2])
    if block == "F":
        X = solve_discrete_lyapunov(at.Fe / r, np.eye(n))
        proof["centre"] = triangle(X)
        slack = min(slack, _slack([X], [at.Fe @ X @ at.Fe.T / r**2]))
    margin = float(share_of_slack * slack)
    if rate is None:
        return _claim("schur-stability", said_stable(block), margin, block=block, proof=proof)
    sentence = said_stable(block, float(rate))
    return _claim("decay-rate", sentence, margin, block=block, rate=float(rate).hex(), proof=proof)


def _slack(X: list[ndarray], image: list[ndarray]) -> float:
    """The largest delta with (1 - delta) X_k above its image, to rounding."""
    return min(1 - max(np.linalg.eigvals(np.linalg.solve(x, y)).real) for x, y in zip(X, image, strict=True))


def instability_claim(data: Document, method: str, *, of: str = "network", block: str = "network") -> Document:
    """A refuted `schur-stability`."""
    at = Numbers(data)
    F = at.network if of == "network" else at.Fe
    d = len(F)
    witness: Document = {"of": of, "method": method}
    if method == "lyapunov":
        X = solve_discrete_lyapunov(F.T, -np.eye(d))
        values, vectors = np.linalg.eigh(0.5 * (X + X.T))
        witness |= {"X": triangle(X), "v": text(vectors[:, np.argmax(values)])}
    else:
        values, vectors = np.linalg.eig(F)
        i = int(np.argmax(abs(values)))
        z = vectors[:, i] / vectors[np.argmax(abs(vectors[:, i])), i]
        witness |= {
            "eigenvalue": text([np.real(values[i]), np.imag(values[i])]),
            "vector": text([np.real(z), np.imag(z)]),
        }
    name = "network" if of == "network" else "least favourable"
    return {
        "claim": "schur-stability",
        "verdict": "refuted",
        "statement": said_unstable(name),
        "margin": None,
        "reason": None,
        "block": block,
        "witness": witness,
    }


def switching_claim(
    data: Document, *, drop: int | None = None, scenarios: list[Document] | None = None, margin: float = 0.01
) -> Document:
    """A proved `switching`; Y is the dual candidate of the nominal network, so loops must contract well."""
    Y = stability_claim(data, "dual")["proof"]["Y"]
    own: Document = {"scenarios": scenarios or []} if drop is None else {"drop": drop}
    return _claim("switching", said_switching(own), margin, **own, proof={"Y": Y})


def performance_claim(data: Document) -> Document:
    """A proved `performance`."""
    at = Numbers(data)
    n, N = at.n, at.N
    F, noise, coupling = at.whole()
    Q = solve_discrete_lyapunov(F, noise)
    Q = 0.5 * (Q + Q.T)
    Z = abs(F @ Q @ F.T + noise - Q) + 1e-14 * abs(Q)
    Y = image = [np.eye(n)] * N
    for _ in range(3000):
        image = [at.M[l].T @ sum(at.sigma[k] * abs(at.W[l, k]) * Y[k] for k in range(N)) @ at.M[l] for l in range(N)]
        Y = [0.5 * (y + y.T) + 1.001 * np.eye(n) for y in image]
    last = solve_discrete_lyapunov(at.Fe.T, np.eye(n))
    delta = 0.25 * min(_slack(Y, image), _slack([last], [at.Fe.T @ last @ at.Fe]))
    reached = sum(C.T @ y @ C for C, y in zip(coupling, Y, strict=True))
    room = delta * ((1 - delta) * last - at.Fe.T @ last @ at.Fe)
    Y.append(last * (1.01 + max(0.0, 2 * max(np.linalg.eigvals(np.linalg.solve(room, reached)).real))))
    root = np.sqrt(np.concatenate([np.diag(y) for y in Y]))
    error = 2 * float(root @ Z @ root) / delta
    traces = [np.trace(Q[k * n : (k + 1) * n, k * n : (k + 1) * n]) for k in range(N + 1)]
    intervals = [(trace - error, trace + error) for trace in traces]
    low, high = (float(x) for x in np.mean(intervals[:N], axis=0))
    low, high = float(low * (1 - 1e-15)), float(high * (1 + 1e-15))
    proof = {
        "Q": triangle(Q),
        "Y": [triangle(y) for y in Y],
        "delta": text([delta]),
    }
    return _claim(
        "performance",
        said_performance(low, high),
        None,
        nodes=[text(pair) for pair in intervals[:N]],
        centre=text(intervals[N]),
        network=text([low, high]),
        proof=proof,
    )
