"""Pictures by matplotlib: headless, deterministic, in colours that colour-blind readers tell apart. Extra `plot`.

Each function returns a `Picture`, which notebooks show and `save` writes; `show` is a viewer to turn a mesh in.
"""

from jaxmark.plot.detection import p_values as p_values
from jaxmark.plot.detection import roc as roc
from jaxmark.plot.detection import success as success
from jaxmark.plot.figures import Picture as Picture
from jaxmark.plot.interactive import Viewer as Viewer
from jaxmark.plot.interactive import show as show
from jaxmark.plot.meshes import View as View
from jaxmark.plot.meshes import displacement as displacement
from jaxmark.plot.meshes import draw as draw
from jaxmark.plot.meshes import exaggerated as exaggerated
from jaxmark.plot.meshes import save_views as save_views
from jaxmark.plot.meshes import visibility as visibility
from jaxmark.plot.spectra import band_visibility as band_visibility
from jaxmark.plot.spectra import responses as responses
from jaxmark.plot.spectra import spectra as spectra
from jaxmark.plot.studies import curves as curves
