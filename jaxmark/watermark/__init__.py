"""Watermarking of meshes: embed messages and fingerprints with a key, read them again, and compute the evidence.

`embed`, `detect`, `capacity`, `fingerprint` and `identify` each do one job on a mesh. `make_marker` and `make_tracer`
prepare an original once for many such jobs. A `Scheme` determines how marks are written and read, a `Budget` how strong
they are. `embed_bits`, `detect_bits` and `log_evidence` are the corresponding pure functions of arrays.
"""

from jaxmark.watermark.bits import detect_bits as detect_bits
from jaxmark.watermark.bits import embed_bits as embed_bits
from jaxmark.watermark.bits import log_evidence as log_evidence
from jaxmark.watermark.blind.field import FieldScheme as FieldScheme
from jaxmark.watermark.blind.local import LocalScheme as LocalScheme
from jaxmark.watermark.blind.rooted import RootedScheme as RootedScheme
from jaxmark.watermark.coding.keys import Key as Key
from jaxmark.watermark.coding.keys import load_key as load_key
from jaxmark.watermark.coding.keys import new_key as new_key
from jaxmark.watermark.coding.keys import save_key as save_key
from jaxmark.watermark.everyday import SceneInfo as SceneInfo
from jaxmark.watermark.everyday import capacity as capacity
from jaxmark.watermark.everyday import detect as detect
from jaxmark.watermark.everyday import detect_scene as detect_scene
from jaxmark.watermark.everyday import embed as embed
from jaxmark.watermark.everyday import embed_scene as embed_scene
from jaxmark.watermark.evidence.detection import Detection as Detection
from jaxmark.watermark.evidence.detection import Evidence as Evidence
from jaxmark.watermark.interfaces import Scheme as Scheme
from jaxmark.watermark.mark import EmbedInfo as EmbedInfo
from jaxmark.watermark.markers import Marker as Marker
from jaxmark.watermark.markers import NonBlindMarker as NonBlindMarker
from jaxmark.watermark.markers import make_marker as make_marker
from jaxmark.watermark.perception.budget import Budget as Budget
from jaxmark.watermark.perception.capacity import Survival as Survival
from jaxmark.watermark.record import Record as Record
from jaxmark.watermark.record import SceneRecord as SceneRecord
from jaxmark.watermark.record import load_record as load_record
from jaxmark.watermark.schemes.keyed import KeyedScheme as KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme as EigenScheme
from jaxmark.watermark.schemes.modulated import HostScheme as HostScheme
from jaxmark.watermark.schemes.own_bands import OwnBandsScheme as OwnBandsScheme
from jaxmark.watermark.schemes.registry import SCHEMES as SCHEMES
from jaxmark.watermark.tracing.tardos import Accusation as Accusation
from jaxmark.watermark.tracing.tracer import Tracer as Tracer
from jaxmark.watermark.tracing.tracer import fingerprint as fingerprint
from jaxmark.watermark.tracing.tracer import identify as identify
from jaxmark.watermark.tracing.tracer import make_tracer as make_tracer
