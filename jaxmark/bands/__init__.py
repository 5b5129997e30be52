"""Families of band filters: coefficient matrices `[bands, degree + 1]` whose rows sum to the constant 1."""

from jaxmark.bands.report import FamilyReport as FamilyReport
from jaxmark.bands.report import report as report
from jaxmark.bands.scaling import scaling as scaling
