"""Families of filters as matrices of Chebyshev coefficients `[bands, degree + 1]`, one filter a row.

Bands sum to the constant 1; the scales of `diffusion`, kernels of `heat` and wavelets do not. `report` measures how
cleanly a family separates a mesh.
"""

from jaxmark.spectral.bands._bernstein import bernstein as bernstein
from jaxmark.spectral.bands._diffusion import diffusion as diffusion
from jaxmark.spectral.bands._hat import hat as hat
from jaxmark.spectral.bands._heat import heat as heat
from jaxmark.spectral.bands._intervals import equal_edges as equal_edges
from jaxmark.spectral.bands._intervals import intervals as intervals
from jaxmark.spectral.bands._lagrange import lagrange as lagrange
from jaxmark.spectral.bands._minimax import Minimax as Minimax
from jaxmark.spectral.bands._minimax import minimax as minimax
from jaxmark.spectral.bands._report import FamilyReport as FamilyReport
from jaxmark.spectral.bands._report import report as report
from jaxmark.spectral.bands._scaling import nodes as nodes
from jaxmark.spectral.bands._scaling import scaling as scaling
from jaxmark.spectral.bands._wavelets import abspline as abspline
from jaxmark.spectral.bands._wavelets import itersine as itersine
from jaxmark.spectral.bands._wavelets import mexican_hat as mexican_hat
from jaxmark.spectral.bands._wavelets import meyer as meyer
from jaxmark.spectral.bands.damping import damping_factors as damping_factors
