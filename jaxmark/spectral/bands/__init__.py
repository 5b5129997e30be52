"""Families of filters as matrices of Chebyshev coefficients `[bands, degree + 1]`, one filter a row.

Families are computed on the host in float64. Unless their functions say otherwise, rows go by increasing frequency, and
sum to the constant 1; the scales of `diffusion`, kernels of `heat` and wavelets do not. `JaxmarkError` is raised for
arguments outside of the ranges that are given. `report` measures how cleanly a family separates a mesh.
"""

from jaxmark.spectral.bands._lowpasses import diffusion as diffusion
from jaxmark.spectral.bands._lowpasses import heat as heat
from jaxmark.spectral.bands._minimax import Interpolation as Interpolation
from jaxmark.spectral.bands._minimax import Minimax as Minimax
from jaxmark.spectral.bands._minimax import fit as fit
from jaxmark.spectral.bands._minimax import hat as hat
from jaxmark.spectral.bands._minimax import minimax as minimax
from jaxmark.spectral.bands._partitions import Damping as Damping
from jaxmark.spectral.bands._partitions import bernstein as bernstein
from jaxmark.spectral.bands._partitions import damping_factors as damping_factors
from jaxmark.spectral.bands._partitions import equal_edges as equal_edges
from jaxmark.spectral.bands._partitions import intervals as intervals
from jaxmark.spectral.bands._partitions import lagrange as lagrange
from jaxmark.spectral.bands._partitions import nodes as nodes
from jaxmark.spectral.bands._partitions import scaling as scaling
from jaxmark.spectral.bands._report import FamilyReport as FamilyReport
from jaxmark.spectral.bands._report import report as report
from jaxmark.spectral.bands._wavelets import abspline as abspline
from jaxmark.spectral.bands._wavelets import itersine as itersine
from jaxmark.spectral.bands._wavelets import mexican_hat as mexican_hat
from jaxmark.spectral.bands._wavelets import meyer as meyer
