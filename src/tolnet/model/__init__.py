"""The vocabulary: networks, problem files, and the results that travel between the rooms."""

from tolnet.model.ambiguity import CONVENTIONS, Ambiguity, Convention, gamma_per
from tolnet.model.diffusion import OBJECTIVES, DecayCertificate, Diffusion, Elsewhere, GainTable, Start
from tolnet.model.dynamics import ErrorDynamics, Performance
from tolnet.model.errors import Complaint, InputError, ShapeError, TolnetError, UnsupportedError
from tolnet.model.examples import example, example_names
from tolnet.model.graph import DIFFUSION_RULES
from tolnet.model.network import SensorNetwork
from tolnet.model.reading import load, parse, validate
from tolnet.model.results import SteadyState, ToleranceLimits, ToleranceTable
from tolnet.model.status import Status
from tolnet.model.whole_files import check_writable, replacing
from tolnet.model.worst_case import LeastFavourableModel
from tolnet.model.writing import save

__all__ = [
    "CONVENTIONS",
    "DIFFUSION_RULES",
    "OBJECTIVES",
    "Ambiguity",
    "Complaint",
    "Convention",
    "DecayCertificate",
    "Diffusion",
    "Elsewhere",
    "ErrorDynamics",
    "GainTable",
    "InputError",
    "LeastFavourableModel",
    "Performance",
    "SensorNetwork",
    "ShapeError",
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
    "parse",
    "replacing",
    "save",
    "validate",
]
