"""The vocabulary: networks, problem files, and the results that travel between the rooms."""

from tolnet.model.ambiguity import CONVENTIONS, Ambiguity, Convention, gamma_per
from tolnet.model.channels import LooseBoundWarning, SimulationModel
from tolnet.model.corrupted import CorruptedNetwork
from tolnet.model.diffusion import OBJECTIVES, DecayCertificate, Diffusion, Elsewhere, GainTable, Start
from tolnet.model.dynamics import ErrorDynamics, Performance
from tolnet.model.errors import Complaint, InputError, ShapeError, TolnetError, UnsupportedError
from tolnet.model.examples import example, example_names
from tolnet.model.fusion import FUSION_RULES
from tolnet.model.fusion_weights import FusionWeights
from tolnet.model.graph import DIFFUSION_RULES
from tolnet.model.network import SensorNetwork
from tolnet.model.reading import load, parse
from tolnet.model.reading_corrupted import load_corrupted, load_problem, parse_corrupted, validate
from tolnet.model.results import SteadyState, ToleranceLimits, ToleranceTable
from tolnet.model.status import Status
from tolnet.model.whole_files import check_writable, replacing
from tolnet.model.worst_case import LeastFavourableModel
from tolnet.model.writing import save

__all__ = [
    "CONVENTIONS",
    "DIFFUSION_RULES",
    "FUSION_RULES",
    "OBJECTIVES",
    "Ambiguity",
    "Complaint",
    "Convention",
    "CorruptedNetwork",
    "DecayCertificate",
    "Diffusion",
    "Elsewhere",
    "ErrorDynamics",
    "FusionWeights",
    "GainTable",
    "InputError",
    "LeastFavourableModel",
    "LooseBoundWarning",
    "Performance",
    "SensorNetwork",
    "ShapeError",
    "SimulationModel",
    "Start",
    "Status",
    "SteadyState",
    "ToleranceLimits",
    "ToleranceTable",
    "TolnetError",
    "UnsupportedError",
    "check_writable",
    "example",
    "example_names",
    "gamma_per",
    "load",
    "load_corrupted",
    "load_problem",
    "parse",
    "parse_corrupted",
    "replacing",
    "save",
    "validate",
]
