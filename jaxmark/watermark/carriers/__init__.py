"""Carriers, which map bits linearly to displacements of the vertices, and their readers.

`Carrier` and `Reader` are the interfaces. `KeyedCarrier` spreads bits over all vertices by keyed signs.
`ModulatedCarrier` writes bits on components of the host, such as `host_bands` and `eigenspaces`. `SpreadCarrier` takes
any linear map of your own from keyed signs to displacements.
"""

from jaxmark.watermark.carriers.chips import Chips as Chips
from jaxmark.watermark.carriers.chips import KeyedCarrier as KeyedCarrier
from jaxmark.watermark.carriers.chips import KeyedReader as KeyedReader
from jaxmark.watermark.carriers.chips import make_chips as make_chips
from jaxmark.watermark.carriers.components import Components as Components
from jaxmark.watermark.carriers.components import Eigenspaces as Eigenspaces
from jaxmark.watermark.carriers.components import HostBands as HostBands
from jaxmark.watermark.carriers.components import eigenspaces as eigenspaces
from jaxmark.watermark.carriers.components import host_bands as host_bands
from jaxmark.watermark.carriers.modulation import ModulatedCarrier as ModulatedCarrier
from jaxmark.watermark.carriers.modulation import PlainReader as PlainReader
from jaxmark.watermark.carriers.spread import SpreadCarrier as SpreadCarrier
from jaxmark.watermark.carriers.spread import make_spread_carrier as make_spread_carrier
from jaxmark.watermark.interfaces import Carrier as Carrier
from jaxmark.watermark.interfaces import Claim as Claim
from jaxmark.watermark.interfaces import Reader as Reader
