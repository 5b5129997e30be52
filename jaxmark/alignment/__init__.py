"""Register a suspect mesh to the original, and measure how each point of the original was displaced.

`make_original` prepares the original; `align` finds the pose and the displacements. All computations run on the host,
and none uses the key.
"""

from jaxmark.alignment.attempts import align as align
from jaxmark.alignment.observation import Observation as Observation
from jaxmark.alignment.observation import observe as observe
from jaxmark.alignment.original import Original as Original
from jaxmark.alignment.original import make_original as make_original
from jaxmark.alignment.result import Align as Align
from jaxmark.alignment.result import Alignment as Alignment
