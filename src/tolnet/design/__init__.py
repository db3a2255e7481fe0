"""Choose: tolerances, diffusion weights, and what is deployed."""

from tolnet.design.diffusion import diffusion_matrix
from tolnet.design.export import export_table, read_table
from tolnet.design.fusion_weights import choose_fusion_weights
from tolnet.design.tolerances import choose_tolerances
from tolnet.design.weights.admissible import Constraints
from tolnet.design.weights.optimise import optimise_diffusion
from tolnet.design.window import choose_window

__all__ = [
    "Constraints",
    "choose_fusion_weights",
    "choose_tolerances",
    "choose_window",
    "diffusion_matrix",
    "export_table",
    "optimise_diffusion",
    "read_table",
]
