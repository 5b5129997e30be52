"""The catalogue: which of many originals a suspect is, under which key and record it was marked, and for whom.

`Catalogue` is a file with originals, records and recipients. `Finder` names the originals that a suspect was made of;
`find_each` does so for many suspects, by any number of workers.
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
from jaxmark.catalogue.stream import Done as Done
from jaxmark.catalogue.stream import Plan as Plan
from jaxmark.catalogue.stream import count as count
from jaxmark.catalogue.stream import find_each as find_each
from jaxmark.catalogue.stream import mesh_files_below as mesh_files_below
