"""The vocabulary: networks, problem files, and the results that travel between the rooms."""

from tolnet.model.ambiguity import CONVENTIONS, Ambiguity, Convention, gamma_per
from tolnet.model.errors import Complaint, InputError, ShapeError, TolnetError, UnsupportedError
from tolnet.model.network import SensorNetwork
from tolnet.model.results import SteadyState, ToleranceLimits, ToleranceTable
from tolnet.model.status import Status

__all__ = [
    "CONVENTIONS",
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
    "gamma_per",
]
