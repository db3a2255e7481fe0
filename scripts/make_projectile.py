"""Write the built-in problem `projectile` again: python scripts/make_projectile.py [--rank]

--rank compares the seeds 0 to 999 with the published row (Table 1 of the source, c = 0.02) and lists the nearest,
which is how `SEED` was chosen. It takes a minute or two.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy import ndarray

from tolnet import analysis, design, model
from tolnet.model.examples import projectile

TARGET = Path(__file__).parents[1] / "src/tolnet/model/examples/projectile.toml"
FILTERS = ("RKFC", "RKFDU", "RKFDNU2")
PUBLISHED = np.array([*10 ** (np.array([-2.9174, -1.5553, -1.6182]) / 10), 1.3366, 0.0144, 0.3576, 0.3764])
"""MSD of those filters, theta of the centre, mean c_k, mean theta of the nodes, and the same with c_k = c."""


def row(seed: int) -> ndarray:
    """The published figures for one draw."""
    network = projectile(seed)
    table, uniform = design.choose_tolerances(network), design.choose_tolerances(network, uniform=True)
    found = analysis.evaluate_filters(table, design.diffusion_matrix(network), filters=FILTERS)
    thetas = (np.mean(each.local.theta) for each in (table, uniform))
    return np.array([*(found[name].msd for name in FILTERS), table.central.theta, np.mean(table.tolerances), *thetas])


def rank(seeds: range) -> None:
    """Print the nearest draws, judged by the figure that is furthest off."""
    deviation = np.array([row(seed) for seed in seeds]) / PUBLISHED - 1
    worst = np.abs(deviation).max(axis=1)
    for i in np.argsort(worst)[:5]:
        print(f"seed {seeds[i]}: no figure is off by more than {worst[i]:.1%}")


if __name__ == "__main__":
    if "--rank" in sys.argv[1:]:
        rank(range(1000))
    else:
        for path in model.save(projectile(), TARGET, arrays=False):
            print(path)
