"""The benchmark of watermarking methods: all mark under the same distortion limits, are attacked, and are calibrated.

`run` runs or resumes a benchmark, `make_corpus` makes the meshes, and a `Method` of your own can take part.
"""

from jaxmark.bench._equal_visibility import equal_visibility as equal_visibility
from jaxmark.bench.benchmark import run as run
from jaxmark.bench.corpus import make_corpus as make_corpus
from jaxmark.bench.method import METHODS as METHODS
from jaxmark.bench.method import Method as Method
from jaxmark.bench.method import Reading as Reading
from jaxmark.bench.method import load_method as load_method
from jaxmark.bench.page import markdown as markdown
from jaxmark.bench.page import save_page as save_page
from jaxmark.bench.paired import Paired as Paired
from jaxmark.bench.paired import compare_paired as compare_paired
from jaxmark.bench.readings import BenchResults as BenchResults
from jaxmark.bench.readings import Repetition as Repetition
from jaxmark.bench.readings import hold_against as hold_against
from jaxmark.bench.readings import load_published as load_published
from jaxmark.bench.readings import save_readings as save_readings
from jaxmark.bench.strength_search import Fitted as Fitted
from jaxmark.bench.strength_search import fit as fit
from jaxmark.bench.summary import entries as entries
from jaxmark.bench.summary import save_entries as save_entries
from jaxmark.bench.tracks import TRACKS as TRACKS
from jaxmark.bench.tracks import Line as Line
from jaxmark.bench.tracks import Track as Track
