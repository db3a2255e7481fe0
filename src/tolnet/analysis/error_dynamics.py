"""The errors of a network's filters under the least favourable model, block sparse, eqs. (35)-(37).

Node k's filter has M_k = A (I + V_k S_k)^-1 = A - A Z_k S_k and hears nu_l = C_l' R_l^-1 D_l v_l of its neighbours,
whose covariance is C_l' R_l^-1 C_l. With u = M' (T F e + Psi m) + eps from the model (m = M eps), before diffusion:

    1.  x~_k+ = M_k x~_k - A Z_k sum_l nu_l + B w                                      for a nominal u = [w; v]
    2.  v_l = eps_l - D_l' R_l^-1 C_l Z A' q,  w = eps_w + B' q,  q = T F e + Psi m    so the sum loses S_k Z A' q
    3.  x~_k+ = M_k x~_k + E_k T F e + (noise),  E_k = Q + A Z_k S_k Z A'
    4.  cov(noise_k, noise_j) = Q + A Z_k S_kj Z_j A' + E_k T E_j', since K = I + M' T M

and the centre's own error e is one more filter, with E = N.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from tolnet.model import (
    Complaint,
    ErrorDynamics,
    InputError,
    LeastFavourableModel,
    SensorNetwork,
    ShapeError,
    Status,
    SteadyState,
)
from tolnet.model.graph import COLUMN_SUM_TOLERANCE
from tolnet.model.sensors import whiten
from tolnet.model.covariances import SIX_DIGITS, TOO_PRECISE, condition, psd_factor


def error_dynamics(
    network: SensorNetwork,
    local: SteadyState,
    W: sparse.csr_array | ndarray | None,
    model: LeastFavourableModel,
) -> ErrorDynamics:
    """F and G of eta+ = F eta + G eps, eta = [x~_1; ...; x~_N; e], under a steady least favourable model.

    `local` is the stack of the nodes' filters, whatever their tolerances (c_k, c or 0), and W (N, N) weighs neighbour
    l at node k, x^_k = sum_l w_lk psi_l; or `local` is one centralised filter without a stack, and W None. A filter
    without a steady state, like a model that does not exist, gives dynamics of that status with a reason and no
    numbers; one that oscillates gives the numbers of its frozen gains.
    Raises ShapeError where `local`, W and the network do not fit, InputError where a column of W does not sum to one.
    Source: eqs. (35)-(37); docs/mathematics.md, section 7.
    """
    centralised = local.theta.ndim == 0
    K = 1 if centralised else network.N
    if local.S.shape != ((network.n, network.n) if centralised else (K, network.n, network.n)):
        raise ShapeError(
            [Complaint("local", f"is a stack of {local.theta.shape}; the network has {network.N} nodes")]
        )
    mixing = _mixing(W, K, centralised)
    heard = sparse.csr_array(np.ones((1, network.N)) if centralised else network.adjacency.T.astype(float))
    status, reason = _standing(network, local, model)
    V, S = local.V.reshape(K, network.n, network.n), local.S.reshape(K, network.n, network.n)
    return filter_errors(model, V, S, heard, mixing, status, reason)


def filter_errors(
    model: LeastFavourableModel,
    V: Float[ndarray, "K n n"],
    S: Float[ndarray, "K n n"],
    heard: sparse.csr_array,
    mixing: sparse.csr_array,
    status: Status = Status.OK,
    reason: str = "",
) -> ErrorDynamics:
    """The same for one instant, from the V_k and S_k that the filters use there, who hears whom (K, N), and W'.

    Assumes a model without time axis: `model[t]` of a finite horizon.
    """
    network = model.network
    A, Q = network.A, network.Q
    posterior = condition(V, S)
    lost = ~(posterior.error <= SIX_DIGITS)
    if model.exists and lost.any() and np.isfinite(V).all():
        status, reason = Status.NOT_CONVERGED, TOO_PRECISE
    loops = A @ np.where(lost[:, None, None], np.nan, posterior.loop)
    AZ, AZ_centre = A @ posterior.covariance, A @ model.filtered
    E = Q + AZ @ S @ AZ_centre.T
    channels, owner = _channels(network)
    Y = _without_zeros(psd_factor(model.tilt)) if model.exists else model.tilt
    everybody = sparse.csr_array(np.ones((1, network.N)))
    return ErrorDynamics(
        model=model,
        loops=loops,
        coupling=E @ model.steering,
        least_favourable_loop=model.closed_loop,
        mixing=mixing,
        gains=np.concatenate([AZ, AZ_centre[None]]),
        hearing=sparse.csr_array(sparse.vstack([heard, everybody])),
        channels=channels,
        owner=owner,
        process=_process_factor(network),
        tilted=np.concatenate([E, model.noise[None]]) @ Y,
        status=status,
        reason=reason,
    )


def _mixing(W: sparse.csr_array | ndarray | None, K: int, centralised: bool) -> sparse.csr_array:
    """W' in CSR, checked."""
    if W is None or centralised:
        if W is not None or not centralised:
            wrong = "is given; a centralised filter mixes with nobody" if centralised else f"is missing; {K} x {K}"
            raise ShapeError([Complaint("W", wrong)])
        return sparse.csr_array(np.ones((1, 1)))
    if W.shape != (K, K):
        raise ShapeError([Complaint("W", f"has the shape {W.shape}; {K} x {K} was expected")])
    mixing = sparse.csr_array(W.T, dtype=np.float64)
    sums = np.asarray(mixing.sum(axis=1))
    off = np.flatnonzero(~(np.abs(sums - 1) <= COLUMN_SUM_TOLERANCE))
    if off.size:
        raise InputError([Complaint("W", f"has column {off[0]} summing to {float(sums[off[0]])!r}; 1 was expected")])
    return mixing


def _standing(network: SensorNetwork, local: SteadyState, model: LeastFavourableModel) -> tuple[Status, str]:
    """The status of the whole from those of the model and of the filters."""
    if not model.exists:
        return model.status, model.reason
    each = local.status.reshape(-1)
    for bad, meaning in ((~local.exists, "has no steady state"), (~local.settles, "never settles")):
        where = np.flatnonzero(bad)
        if where.size:
            k = int(where[0])
            who = "the centralised filter" if local.theta.ndim == 0 else f"the filter of node {network.label(k)}"
            return Status(str(each[k])), f"{who} {meaning} ({each[k]})"
    return model.status, model.reason


def _channels(network: SensorNetwork) -> tuple[Float[ndarray, "c n"], Int[ndarray, " c"]]:
    """Columns f of C_l' R_l^-1/2 of every sensor, those that are not zero, and the sensor of each."""
    columns, owner = [np.empty((0, network.n))], [np.empty(0, dtype=np.int64)]
    for nodes, C, R in network.sensors.groups():
        f = whiten(C, R)
        if f.shape[1] > network.n:  # more outputs than states: n columns carry the same information
            f = np.asarray(np.linalg.qr(f, mode="r"))
        node, row = np.nonzero(np.any(f, axis=2))
        columns.append(f[node, row])
        owner.append(nodes[node])
    return np.concatenate(columns), np.concatenate(owner)


def _process_factor(network: SensorNetwork) -> Float[ndarray, "n m"]:
    """B, or a factor of Q where the network was given Q."""
    return _without_zeros(psd_factor(network.Q) if network.B is None else network.B)


def _without_zeros(B: Float[ndarray, "n m"]) -> Float[ndarray, "n r"]:
    return B[:, B.any(axis=0)]
