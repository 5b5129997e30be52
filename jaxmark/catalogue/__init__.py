"""The catalogue: identify the original, the key, the record and the recipient of a suspect, among many originals.

A `Catalogue` is a file with originals, records and recipients. A `Finder` names the originals that a suspect was made
from; `find_each` does so for many suspects, with any number of workers.
"""

from jaxmark.catalogue.catalogue import Added as Added
from jaxmark.catalogue.catalogue import Catalogue as Catalogue
from jaxmark.catalogue.catalogue import Entry as Entry
from jaxmark.catalogue.catalogue import Kept as Kept
from jaxmark.catalogue.exchange import Counted as Counted
from jaxmark.catalogue.exchange import export_catalogue as export_catalogue
from jaxmark.catalogue.exchange import import_catalogue as import_catalogue
from jaxmark.catalogue.identification import Finder as Finder
from jaxmark.catalogue.identification import Match as Match
from jaxmark.catalogue.identification import Verdict as Verdict
from jaxmark.catalogue.pieces import LeftOut as LeftOut
from jaxmark.catalogue.stream import Done as Done
from jaxmark.catalogue.stream import Plan as Plan
from jaxmark.catalogue.stream import count as count
from jaxmark.catalogue.stream import find_each as find_each
from jaxmark.catalogue.stream import mesh_files_below as mesh_files_below
