"""How far a mesh was moved: metrics, one a module."""

from jaxmark.distortion.compare import Comparison as Comparison
from jaxmark.distortion.compare import compare as compare
from jaxmark.distortion.displacement import maximum as maximum
from jaxmark.distortion.displacement import rms as rms
