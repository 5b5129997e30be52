"""What this library has itself, as the benchmark sees it: its own schemes, two historical ones, and the public tool's.

The informed schemes are read from one alignment of the suspect with the original, which all keys share. The message is
the best guess, whether or not its tag fits. The score is the evidence, -log10 of the bound without its floor, and where
there is none, how well the soft values agree with the codeword of the guess, from -1 to 1.
"""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, tee

import numpy as np

from jaxmark.alignment.alignment import Alignment, align
from jaxmark.alignment.original import Original, make_original
from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.harmonics import THRESHOLD, HarmonicMark, make_mark
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.reading import TAG_BITS, codeword, context, read, register
from jaxmark.watermark.blind.scheme import BlindScheme, Look
from jaxmark.watermark.coding.keys import Choices, Key
from jaxmark.watermark.coding.message import guess
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.markers import BlindMarker, NonBlindMarker, make_blind_marker, make_marker
from jaxmark.watermark.perception.budget import Bounds, Budget
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.modulated import EigenScheme, HostScheme
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES

_RMS = (2e-6, 1e-2)  # displacements over the diagonal
_OURS = "the scheme is defined by this code"
_OUR_BLIND = "jaxmark, docs/blind.md"
_OHBUCHI = "Ohbuchi, Takahashi, Miyazawa, Mukaiyama, Watermarking 3D polygonal meshes in the mesh spectral domain, 2001"
_SOHN = "Sohn et al., A Digital Watermarking Scheme for Polygonal Meshes using Modified Spectral Decomposition"


@dataclass(frozen=True, eq=False)
class Held:
    """A mesh that is known by its arrays themselves, which a cache that has it as a key keeps alive."""

    mesh: Mesh

    def __hash__(self) -> int:
        return hash((id(self.mesh.vertices), id(self.mesh.faces)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Held) and all(a is b for a, b in zip(self.mesh, other.mesh, strict=True))


@dataclass(frozen=True)
class SharedField(FieldScheme):
    """The scheme `field`, which looks at a suspect once for all keys that read it, as no key decides what it sees."""

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[Look]:
        """See `BlindScheme`."""
        return copy(_views(self, Held(suspect)))


@lru_cache(maxsize=2)
def _views(scheme: FieldScheme, suspect: Held) -> Iterator[Look]:
    """What a scheme sees of a suspect, whose copies start anew; a suspect that it refuses is refused each time."""
    looks = FieldScheme.views(scheme, suspect.mesh, Choices(Key(bytes(32)), b""))
    return tee(chain([next(looks)], looks), 1)[0]


def keyed(bits: int) -> Method:
    """The default scheme: keyed signs of its own in the bands."""
    return _method("keyed", KeyedScheme(), bits, "jaxmark, docs/how_it_works.md", _OURS)


def eigen(bits: int) -> Method:
    """Ohbuchi's: the lowest eigenvectors of the graph Laplacian."""
    return _method("eigen", EigenScheme(), bits, _OHBUCHI)


def host(bits: int) -> Method:
    """Sohn's, in the form that works."""
    return _method("host", HostScheme(), bits, _SOHN)


def paper(bits: int) -> Method:
    """Sohn's as printed."""
    printed = HostScheme(kernel="printed", damping="none", unit_norm=False)
    return _method("paper", printed, bits, f"{_SOHN}, as printed")


def field(bits: int) -> Method:
    """The blind scheme that survives any other meshing."""
    return _method("field", SharedField(), bits, _OUR_BLIND, _OURS, blind=True)


def local(bits: int) -> Method:
    """The blind scheme that is read from any part."""
    return _method("local", BLIND_SCHEMES["local"], bits, _OUR_BLIND, _OURS, blind=True)


def harmonics(bits: int) -> Method:
    """The public tool's, which says only that a mark is there, whatever message is asked for.

    Its reader is not told how large the mark is, and so accepts differences of any size.
    """
    return Method(
        "harmonics",
        _embed_harmonics,
        _read_harmonics,
        blind=False,
        bits=0,
        strengths=_RMS,
        source="Forensic 3D Watermarking Suite, archtecgr",
        threshold=THRESHOLD,
    )


def _method(
    name: str, scheme: Scheme | BlindScheme, bits: int, source: str, anchor: str = "", *, blind: bool = False
) -> Method:
    embed, read = (_embed_blind, _read_blind) if blind else (_embed, _read)
    return Method(
        name,
        partial(embed, scheme),
        partial(read, scheme, bits),
        blind=blind,
        bits=bits,
        strengths=_RMS,
        source=source,
        anchor=anchor,
    )


@lru_cache(maxsize=4)
def _marker(scheme: Scheme, original: Held, key: bytes, bits: int) -> NonBlindMarker:
    return make_marker(original.mesh, key, bits=bits, scheme=scheme)


@lru_cache(maxsize=4)
def _blind_marker(scheme: BlindScheme, original: Held, key: bytes, bits: int) -> BlindMarker:
    return make_blind_marker(original.mesh, key, bits=bits, scheme=scheme)


@lru_cache(maxsize=2)
def _original(mesh: Held) -> Original:
    return make_original(mesh.mesh)


@lru_cache(maxsize=2)
def _aligned(original: Held, suspect: Held) -> Alignment:
    """How a suspect is brought back to an original, whatever the key."""
    return align(_original(original), suspect.mesh)


@lru_cache(maxsize=2)
def _harmonic_mark(original: Held, key: bytes) -> HarmonicMark:
    return make_mark(original.mesh, list(key))


@lru_cache(maxsize=2)
def _registered(suspect: Held) -> Mesh:
    """A suspect as blind readers take it, whatever the key."""
    return register(suspect.mesh)


def _embed(scheme: Scheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = _marker(scheme, Held(mesh), key, len(message))
    return marker.embed(np.packbits(message).tobytes(), Budget(rms=strength, noise=0), read_back=False)[0]


def _embed_blind(scheme: BlindScheme, mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    marker = _blind_marker(scheme, Held(mesh), key, len(message))
    return marker.embed(np.packbits(message).tobytes(), strength, read_back=False)[0]


def _read(scheme: Scheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    assert original is not None
    marker = _marker(scheme, Held(original), key, bits)
    found = marker.read(_aligned(Held(original), Held(suspect)))
    return _reading(found, marker.guess(found) if bits else None, marker.codeword)


def _read_blind(scheme: BlindScheme, bits: int, suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    choices = context(Key(key), bits, scheme.name)
    found = read(_registered(Held(suspect)), Key(key), bits, scheme)
    said = found.message or (guess(found.scores, bits, TAG_BITS) if bits else None)
    return _reading(found, said, lambda message: codeword(message, choices))


def _reading(found: Detection, said: bytes | None, encode: Callable[[bytes], np.ndarray]) -> Reading:
    evidence = found.evidence
    if said is None:
        return Reading(None, 0.0 - evidence.log10_p_unfloored, evidence.log10_p)
    word = encode(said)
    agreement = float(found.scores @ word / np.linalg.norm(found.scores) / np.linalg.norm(word))
    message = np.unpackbits(np.frombuffer(said, np.uint8)).astype(bool)
    return Reading(message, agreement - evidence.log10_p_unfloored, evidence.log10_p)


def _embed_harmonics(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
    return _harmonic_mark(Held(mesh), key).embed(Bounds(strength, {}))


def _read_harmonics(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    assert original is not None
    found = _harmonic_mark(Held(original), key).correlation(suspect, 0.0)
    return Reading(None, float(np.nan_to_num(found)))
