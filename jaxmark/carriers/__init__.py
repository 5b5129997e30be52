"""Carriers: linear maps from bits to a displacement of the vertices, each with its explicit adjoint."""

from jaxmark.carriers.carrier import Carrier as Carrier
from jaxmark.carriers.carrier import ModulatedCarrier as ModulatedCarrier
from jaxmark.carriers.eigen import Eigenspaces as Eigenspaces
from jaxmark.carriers.eigen import eigenspaces as eigenspaces
from jaxmark.carriers.host import HostBands as HostBands
from jaxmark.carriers.host import host_bands as host_bands
from jaxmark.carriers.keyed import Chips as Chips
from jaxmark.carriers.keyed import KeyedCarrier as KeyedCarrier
from jaxmark.carriers.keyed import make_chips as make_chips
