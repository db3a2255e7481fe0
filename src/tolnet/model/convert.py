"""Values of other libraries at the door: python-control plants and networkx graphs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from tolnet.model._checks import Complaints

if TYPE_CHECKING:
    import networkx


def plant_matrices(plant: Any, B: Any, Q: Any, dt: float | None, complaints: Complaints) -> tuple[Any, Any, Any]:
    """A, B and dt of a discrete-time `control.StateSpace`; B and dt given beside it come first.

    The plant's input matrix is taken for the factor B of the process noise. A continuous-time plant is refused,
    since only its user can say how it is sampled.
    """
    if plant.dt == 0:
        complaints.add("plant", "is a continuous-time system; sample it first: plant.sample(dt)")
    step = float(plant.dt) if dt is None and isinstance(plant.dt, int | float) and plant.dt is not True else dt
    factor = np.asarray(plant.B) if B is None and Q is None else B
    return np.asarray(plant.A), factor, step


def adjacency_of_graph(graph: networkx.Graph) -> sparse.csr_array:
    """The 0/1 adjacency of a networkx graph in the order of its nodes; edge attributes are not weights here."""
    import networkx

    return sparse.csr_array(networkx.to_scipy_sparse_array(graph, weight=None, format="csr"))
