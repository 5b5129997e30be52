"""The schemes of this library as methods of the benchmark, including two historical schemes, and a public tool's mark.

The message is the best guess, whether its tag matches or not. The score is the evidence, -log10 of the bound without
its floor. If a message is guessed, the score also includes the correlation of the soft decisions with its codeword,
from -1 to 1.
"""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import chain, tee

import numpy as np

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.harmonics import THRESHOLD, make_mark
from jaxmark.bench.methods.shared import aligned, once
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

_RMS = (2e-6, 1e-2)  # range of strengths: RMS displacements over the diagonal
_OURS = "the scheme is defined by this code"
_OHBUCHI = "Ohbuchi, Takahashi, Miyazawa, Mukaiyama, Watermarking 3D polygonal meshes in the mesh spectral domain, 2001"
_SOHN = "Sohn et al., A Digital Watermarking Scheme for Polygonal Meshes using Modified Spectral Decomposition"


@dataclass(frozen=True)
class SharedField(FieldScheme):
    """The scheme `field` with views of a suspect that are computed once for all keys, because they depend on no key."""

    with_hint: bool = False  # methods read without a record

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[list[Look]]:
        """Return the views of a suspect, see `BlindScheme`."""
        return copy(once(_views, self, suspect))


def _views(scheme: FieldScheme, suspect: Mesh) -> Iterator[list[Look]]:
    """Compute the views of a suspect lazily; copies start from the beginning. Errors are raised at once, uncached."""
    looks = FieldScheme.views(scheme, suspect, Choices(Key(bytes(32)), b""))
    return tee(chain([next(looks)], looks), 1)[0]


def _embed(scheme: Scheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = once(make_marker, mesh, key, bits=len(message), scheme=scheme)
    return marker.embed(np.packbits(message).tobytes(), Budget(rms=strength, noise=0), read_back="never")[0]


def _embed_blind(scheme: BlindScheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = once(make_blind_marker, mesh, key, bits=len(message), scheme=scheme)
    return marker.embed(np.packbits(message).tobytes(), strength, read_back="never")[0]


def _read(scheme: Scheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    assert original is not None, "readers that are not blind are given the original"
    marker = once(make_marker, original, key, bits=bits, scheme=scheme)
    detection = marker.read(aligned(original, suspect))
    return _reading(detection, marker.guess(detection) if bits else None, marker.codeword)


def _read_blind(scheme: BlindScheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    choices = context(Key(key), bits, scheme.name)
    detection = read(once(register, suspect), Key(key), bits, scheme)
    message = detection.message or (guess(detection.scores, bits, TAG_BITS) if bits else None)
    return _reading(detection, message, partial(codeword, choices=choices))


def _reading(detection: Detection, message: bytes | None, encode: Callable[[bytes], np.ndarray]) -> Reading:
    evidence = detection.evidence
    if message is None:
        return Reading(None, 0.0 - evidence.log10_p_unfloored, evidence.log10_p)
    word = encode(message)
    correlation = float(detection.scores @ word / np.linalg.norm(detection.scores) / np.linalg.norm(word))
    bits = np.unpackbits(np.frombuffer(message, np.uint8)).astype(bool)
    return Reading(bits, correlation - evidence.log10_p_unfloored, evidence.log10_p)


def _method(scheme: Scheme | BlindScheme, source: str, anchor: str, bits: int) -> Method:
    blind = isinstance(scheme, BlindScheme)
    embed, read = (_embed_blind, _read_blind) if blind else (_embed, _read)
    return Method(scheme.name, partial(embed, scheme), partial(read, scheme, bits), blind, bits, _RMS, source, anchor)


# Each function makes a method for a payload in bits. `paper` is Sohn's scheme as printed, `host` a variant that works.
keyed = partial(_method, KeyedScheme(), "jaxmark, docs/how_it_works.md", _OURS)
eigen = partial(_method, EigenScheme(), _OHBUCHI, "")
host = partial(_method, HostScheme(), _SOHN, "")
paper = partial(_method, HostScheme(kernel="printed", damping="none", unit_norm=False), f"{_SOHN}, as printed", "")
field = partial(_method, SharedField(), "jaxmark, docs/blind.md", _OURS)
local = partial(_method, BLIND_SCHEMES["local"], "jaxmark, docs/blind.md", _OURS)
rooted = partial(_method, BLIND_SCHEMES["rooted"], "jaxmark, docs/blind.md", _OURS)


def harmonics(bits: int) -> Method:
    """Make the method of a public tool, which shows presence only and ignores the requested payload.

    The reader does not know the size of the mark; therefore it accepts differences of any size.
    """

    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        return once(make_mark, mesh, key).embed(Bounds(strength, {}))

    def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        correlation = once(make_mark, original, key).correlation(suspect, 0.0)
        return Reading(None, float(np.nan_to_num(correlation)))

    source = "Forensic 3D Watermarking Suite, archtecgr"
    return Method("harmonics", embed, read, False, 0, _RMS, source, threshold=THRESHOLD)
