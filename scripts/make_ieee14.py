"""Write the built-in problem `ieee14` again: python scripts/make_ieee14.py

Needs pandapower, which tolnet does not: make an environment with both. The grid is the IEEE 14-bus test case as
pandapower ships it, in the DC power-flow approximation:

    flow from bus i to bus j = b_ij (theta_i - theta_j),   b_ij = 1 / (x_ij tap_ij),   per unit, theta of the slack 0

The 13 other angles wander slowly around the power flow's, x+ = 0.98 x + r + 0.01 w with r = 0.02 theta, and start
in their stationary distribution. Each bus measures its own angle (the slack has none) and the flows on its own
branches, all with a standard deviation of 0.01 (rad; per unit), and hears the buses at their other ends.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from tolnet import model

TARGET = Path(__file__).parents[1] / "src/tolnet/model/examples/ieee14.toml"
DECAY, VARIANCE, DEVIATION = 0.98, 1e-4, 0.01
TOLERANCE = 2e-4
"""Every node's filter settles. From 5.1e-4 on the first one, at a bus that sees few of the angles, does not."""
FROM, TO, X, TAP, SHIFT = 0, 1, 3, 8, 9
"""Columns of a branch table in the format of MATPOWER."""


def grid() -> tuple[ndarray, ndarray, ndarray, ndarray, int]:
    """Branches (E, 2), their b, the angles of the DC power flow (rad), positions of the buses, and the slack."""
    pandapower: Any = importlib.import_module("pandapower")
    networks: Any = importlib.import_module("pandapower.networks")
    case = networks.case14()
    pandapower.rundcpp(case, numba=False)
    branch = np.real(case._ppc["branch"])
    if np.any(branch[:, SHIFT]):
        raise SystemExit("the case has phase shifters, which this script does not model")
    order = np.lexsort((branch[:, TO], branch[:, FROM]))
    ends = branch[order][:, [FROM, TO]].astype(int)
    # The case is stored in ohm; ten digits bring back the published reactances, which have five.
    b = 1.0 / (np.round(branch[order, X], 10) * np.round(branch[order, TAP], 10))
    angles = np.deg2rad(case.res_bus.va_degree.to_numpy())
    positions = np.array([json.loads(point)["coordinates"] for point in case.bus.geo])
    return ends, b, angles, np.round(positions, 4), int(case.ext_grid.bus.iloc[0])


def main() -> None:
    """Build the network and save it."""
    ends, b, angles, positions, slack = grid()
    N = len(angles)
    state = np.delete(np.arange(N), slack)
    C: list[ndarray] = []
    for bus in range(N):
        rows = [] if bus == slack else [np.eye(N)[bus]]
        for (i, j), b_ij in zip(ends, b, strict=True):
            if bus in (i, j):
                rows.append(b_ij * (np.eye(N)[bus] - np.eye(N)[j if bus == i else i]))
        C.append(np.array(rows)[:, state])
    n = N - 1
    network = model.SensorNetwork(
        A=DECAY * np.eye(n),
        Q=VARIANCE * np.eye(n),
        C=C,
        R=[DEVIATION**2 * np.eye(len(C_k)) for C_k in C],
        edges=np.unique(np.sort(ends, axis=1), axis=0),
        input=(1 - DECAY) * angles[state],
        initial_mean=angles[state],
        initial_covariance=VARIANCE / (1 - DECAY**2) * np.eye(n),
        states=[f"theta {bus + 1}" for bus in state],
        positions=positions,
        names=[f"bus {bus + 1}" for bus in range(N)],
        name="ieee14",
        description="IEEE 14-bus grid: each bus estimates all 13 voltage angles (rad) beside the slack's",
        ambiguity=model.Ambiguity(TOLERANCE),
    )
    for path in model.save(network, TARGET, arrays=False):
        print(path)


if __name__ == "__main__":
    main()
