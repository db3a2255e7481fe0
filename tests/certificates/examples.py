"""Valid certificates of tiny networks, one a method, made by tests/reference/certificates.py."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
from tests.reference import certificates as maker
from tests.reference.certificates import Document, document, text


def certificate(name: str) -> Document:
    """A fresh copy of the certificate of this name."""
    return copy.deepcopy(certificates()[name])


@cache
def certificates() -> dict[str, Document]:
    """All of them, by name."""
    rng = np.random.default_rng(20)
    ring, path, one_way = maker.ring(3), maker.path(3), maker.one_way(3)
    network = maker.random_data(rng, 2, ring, radius=1.05)
    signed = maker.random_data(rng, 2, path, negative=True)
    relayed = maker.random_data(rng, 2, path, relays=(1,), factors=True, columns=2)
    directed = maker.random_data(rng, 1, one_way, directed=True, columns=0)
    single = maker.random_data(rng, 2, [[0]])
    calm = maker.random_data(np.random.default_rng(3), 2, ring, radius=0.2)
    calm_one_way = maker.random_data(np.random.default_rng(6), 2, one_way, directed=True, radius=0.2)
    restless = maker.random_data(rng, 2, ring, radius=1.05)
    restless["A"] = text([5 * float.fromhex(x) for x in restless["A"].split()])
    tilted = maker.random_data(np.random.default_rng(5), 2, path, radius=1.2, columns=2, tilt=6.0)
    found = {
        f"{method} {block}": document(network, maker.stability_claim(network, method, block=block))
        for method in ("primal", "dual", "power", "full")
        for block in ("network", "F")
    }
    found |= {
        f"rate {method}": document(data, maker.stability_claim(data, method, rate=0.97, block="F"))
        for method, data in (("primal", signed), ("dual", relayed), ("power", signed), ("full", directed))
    }
    drops = {"drop": [[0, 1]]}
    swapped = calm["gains"][::-1]
    turned = [text(np.roll([float.fromhex(w) for w in row.split()], 1)) for row in calm["weights"]]
    found |= {
        "performance": document(network, maker.performance_claim(network)),
        "performance, relays": document(relayed, maker.performance_claim(relayed)),
        "performance, directed": document(directed, maker.performance_claim(directed)),
        "performance, one node": document(single, maker.performance_claim(single)),
        "drop 1": document(calm, maker.switching_claim(calm, drop=1)),
        "drop 2": document(calm, maker.switching_claim(calm, drop=2)),
        "drop 1, directed": document(calm_one_way, maker.switching_claim(calm_one_way, drop=1)),
        "scenarios": document(
            calm,
            maker.switching_claim(
                calm,
                scenarios=[drops, {"drop": [[0, 1], [1, 2]]}, {"weights": turned}, {"gains": swapped}, {}],
            ),
        ),
        "scenarios, directed": document(
            calm_one_way, maker.switching_claim(calm_one_way, scenarios=[drops, {"drop": [[0, 1], [2, 0]]}])
        ),
        "lyapunov": document(restless, maker.instability_claim(restless, "lyapunov", block="F")),
        "lyapunov, centre": document(tilted, maker.instability_claim(tilted, "lyapunov", of="centre", block="F")),
    }
    return found
