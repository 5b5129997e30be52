"""Pictures of meshes and spectra by matplotlib; they need no screen, and are deterministic. Needs the extra `plot`.

`draw`, `draw_renderings` and the functions of spectra return a `Picture`, which notebooks show and `save` writes;
`show` returns an interactive view of a mesh.
"""

from jaxmark.plot._spectra import responses as responses
from jaxmark.plot._spectra import spectra as spectra
from jaxmark.plot._spectra import strengths as strengths
from jaxmark.plot.figures import Picture as Picture
from jaxmark.plot.interactive import Viewer as Viewer
from jaxmark.plot.interactive import show as show
from jaxmark.plot.meshes import View as View
from jaxmark.plot.meshes import displacement as displacement
from jaxmark.plot.meshes import draw as draw
from jaxmark.plot.meshes import exaggerate as exaggerate
from jaxmark.plot.meshes import save_views as save_views
from jaxmark.plot.meshes import shading as shading
from jaxmark.plot.meshes import visibility as visibility
from jaxmark.plot.reflections import Rendering as Rendering
from jaxmark.plot.reflections import draw_renderings as draw_renderings
from jaxmark.plot.reflections import render as render
