"""The benchmark of the field: every method under one roof, as strong as one set of limits allows, and calibrated.

`run` runs what is not finished of it; `make_corpus` makes the meshes; a `Method` of one's own takes part as any other.
"""

from jaxmark.bench.benchmark import run as run
from jaxmark.bench.corpus import make_corpus as make_corpus
from jaxmark.bench.equal import equal_visibility as equal_visibility
from jaxmark.bench.fitting import Fitted as Fitted
from jaxmark.bench.fitting import fit as fit
from jaxmark.bench.leagues import LEAGUES as LEAGUES
from jaxmark.bench.leagues import League as League
from jaxmark.bench.leagues import Line as Line
from jaxmark.bench.method import METHODS as METHODS
from jaxmark.bench.method import Method as Method
from jaxmark.bench.method import Reading as Reading
from jaxmark.bench.page import markdown as markdown
from jaxmark.bench.page import save_page as save_page
from jaxmark.bench.paired import Paired as Paired
from jaxmark.bench.paired import compare_paired as compare_paired
from jaxmark.bench.plugins import load_method as load_method
from jaxmark.bench.repeat import Repetition as Repetition
from jaxmark.bench.repeat import hold_against as hold_against
from jaxmark.bench.repeat import load_published as load_published
from jaxmark.bench.repeat import save_readings as save_readings
from jaxmark.bench.results import BenchResults as BenchResults
from jaxmark.bench.summary import entries as entries
from jaxmark.bench.summary import save_entries as save_entries
