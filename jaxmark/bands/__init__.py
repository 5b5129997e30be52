"""Families of filters as coefficient matrices `[bands, degree + 1]`: bands sum to the constant 1, scales do not."""

from jaxmark.bands.diffusion import diffusion as diffusion
from jaxmark.bands.report import FamilyReport as FamilyReport
from jaxmark.bands.report import report as report
from jaxmark.bands.scaling import scaling as scaling
