"""The vocabulary: networks, problem files, and the results that travel between the rooms."""

from tolnet.model.ambiguity import CONVENTIONS, Ambiguity, Convention, gamma_per
from tolnet.model.errors import Complaint, InputError, ShapeError, TolnetError, UnsupportedError
from tolnet.model.graph import DIFFUSION_RULES
from tolnet.model.network import SensorNetwork
from tolnet.model.reading import load, parse, validate
from tolnet.model.results import SteadyState, ToleranceLimits, ToleranceTable
from tolnet.model.status import Status
from tolnet.model.whole_files import check_writable, replacing
from tolnet.model.writing import save

__all__ = [
    "CONVENTIONS",
    "DIFFUSION_RULES",
    "Ambiguity",
    "Complaint",
    "Convention",
    "InputError",
    "SensorNetwork",
    "ShapeError",
    "Status",
    "SteadyState",
    "ToleranceLimits",
    "ToleranceTable",
    "TolnetError",
    "UnsupportedError",
    "check_writable",
    "gamma_per",
    "load",
    "parse",
    "replacing",
    "save",
    "validate",
]
