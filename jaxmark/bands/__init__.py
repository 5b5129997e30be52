"""Families of filters as coefficient matrices `[bands, degree + 1]`: bands sum to the constant 1, scales do not."""

from jaxmark.bands.bernstein import bernstein as bernstein
from jaxmark.bands.damping import damping_factors as damping_factors
from jaxmark.bands.diffusion import diffusion as diffusion
from jaxmark.bands.hat import hat as hat
from jaxmark.bands.intervals import equal_edges as equal_edges
from jaxmark.bands.intervals import intervals as intervals
from jaxmark.bands.lagrange import lagrange as lagrange
from jaxmark.bands.minimax import Minimax as Minimax
from jaxmark.bands.minimax import minimax as minimax
from jaxmark.bands.report import FamilyReport as FamilyReport
from jaxmark.bands.report import report as report
from jaxmark.bands.scaling import nodes as nodes
from jaxmark.bands.scaling import scaling as scaling
