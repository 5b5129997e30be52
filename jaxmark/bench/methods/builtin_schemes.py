"""The schemes of this library as methods, two historical ones among them, and the mark of a public tool.

The informed schemes are read from one alignment of the suspect with the original, which all keys share. The message is
the best guess, whether or not its tag fits. The score is the evidence, -log10 of the bound without its floor, plus,
where a message is guessed, the correlation of the soft decisions with its codeword, from -1 to 1.
"""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, tee
from typing import Any

import numpy as np

from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import make_original
from jaxmark.alignment.result import Alignment
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.harmonics import THRESHOLD, make_mark
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.reading import TAG_BITS, codeword, context, read, register
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.coding.keys import Choices, Key
from jaxmark.watermark.coding.message import guess
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.markers import make_blind_marker, make_marker
from jaxmark.watermark.perception.budget import Bounds, Budget
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES

_RMS = (2e-6, 1e-2)  # displacements over the diagonal
_OURS = "the scheme is defined by this code"
_OHBUCHI = "Ohbuchi, Takahashi, Miyazawa, Mukaiyama, Watermarking 3D polygonal meshes in the mesh spectral domain, 2001"
_SOHN = "Sohn et al., A Digital Watermarking Scheme for Polygonal Meshes using Modified Spectral Decomposition"


@dataclass(frozen=True, eq=False)
class _Identified:
    """A mesh as a key of a cache, which is identified by its arrays and keeps them alive."""

    mesh: Mesh

    def __hash__(self) -> int:
        return hash((id(self.mesh.vertices), id(self.mesh.faces)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identified) and all(a is b for a, b in zip(self.mesh, other.mesh, strict=True))


def _once(make: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Call a function, or return what it returned for the same arguments; meshes are the same by their arrays."""
    return _cached(make, *(_Identified(one) if isinstance(one, Mesh) else one for one in given), **options)


@lru_cache(maxsize=12)
def _cached(make: Callable[..., Any], *given: Any, **options: Any) -> Any:
    return make(*(one.mesh if isinstance(one, _Identified) else one for one in given), **options)


@dataclass(frozen=True)
class SharedField(FieldScheme):
    """The scheme `field`, which looks at a suspect once for all keys that read it, as no key decides what it sees."""

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[Look]:
        """See `BlindScheme`."""
        return copy(_once(_views, self, suspect))


def _views(scheme: FieldScheme, suspect: Mesh) -> Iterator[Look]:
    """Look at a suspect lazily; copies start from the beginning, and a refusal is raised at once, never cached."""
    looks = FieldScheme.views(scheme, suspect, Choices(Key(bytes(32)), b""))
    return tee(chain([next(looks)], looks), 1)[0]


def _align(original: Mesh, suspect: Mesh) -> Alignment:
    return align(_once(make_original, original), suspect)


def _embed(scheme: Scheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = _once(make_marker, mesh, key, bits=len(message), scheme=scheme)
    return marker.embed(np.packbits(message).tobytes(), Budget(rms=strength, noise=0), read_back=False)[0]


def _embed_blind(scheme: BlindScheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = _once(make_blind_marker, mesh, key, bits=len(message), scheme=scheme)
    return marker.embed(np.packbits(message).tobytes(), strength, read_back=False)[0]


def _read(scheme: Scheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    marker = _once(make_marker, original, key, bits=bits, scheme=scheme)
    found = marker.read(_once(_align, original, suspect))
    return _reading(found, marker.guess(found) if bits else None, marker.codeword)


def _read_blind(scheme: BlindScheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    choices = context(Key(key), bits, scheme.name)
    found = read(_once(register, suspect), Key(key), bits, scheme)
    message = found.message or (guess(found.scores, bits, TAG_BITS) if bits else None)
    return _reading(found, message, partial(codeword, choices=choices))


def _reading(found: Detection, message: bytes | None, encode: Callable[[bytes], np.ndarray]) -> Reading:
    evidence = found.evidence
    if message is None:
        return Reading(None, 0.0 - evidence.log10_p_unfloored, evidence.log10_p)
    word = encode(message)
    correlation = float(found.scores @ word / np.linalg.norm(found.scores) / np.linalg.norm(word))
    bits = np.unpackbits(np.frombuffer(message, np.uint8)).astype(bool)
    return Reading(bits, correlation - evidence.log10_p_unfloored, evidence.log10_p)


def _method(scheme: Scheme | BlindScheme, source: str, anchor: str, bits: int) -> Method:
    blind = isinstance(scheme, BlindScheme)
    embed, read = (_embed_blind, _read_blind) if blind else (_embed, _read)
    return Method(scheme.name, partial(embed, scheme), partial(read, scheme, bits), blind, bits, _RMS, source, anchor)


# Each makes a method from the size of its message. `paper` is Sohn's scheme as printed, `host` the form that works.
keyed = partial(_method, KeyedScheme(), "jaxmark, docs/how_it_works.md", _OURS)
eigen = partial(_method, EigenScheme(), _OHBUCHI, "")
host = partial(_method, HostScheme(), _SOHN, "")
paper = partial(_method, HostScheme(kernel="printed", damping="none", unit_norm=False), f"{_SOHN}, as printed", "")
field = partial(_method, SharedField(), "jaxmark, docs/blind.md", _OURS)
local = partial(_method, BLIND_SCHEMES["local"], "jaxmark, docs/blind.md", _OURS)


def harmonics(bits: int) -> Method:
    """The mark of a public tool, which shows presence only, whatever message is asked for.

    Its reader is not given the size of the mark, and so accepts differences of any size.
    """

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        return _once(make_mark, mesh, key).embed(Bounds(strength, {}))

    def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        found = _once(make_mark, original, key).correlation(suspect, 0.0)
        return Reading(None, float(np.nan_to_num(found)))

    source = "Forensic 3D Watermarking Suite, archtecgr"
    return Method("harmonics", embed, read, False, 0, _RMS, source, threshold=THRESHOLD)
