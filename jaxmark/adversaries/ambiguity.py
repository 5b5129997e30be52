"""Attacks on what a detection proves: claims on a mesh by somebody who did not mark it, and marks copied elsewhere."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.alignment.alignment import align, observation
from jaxmark.alignment.original import make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, host_mesh, same_connectivity
from jaxmark.watermark.coding.keys import KEY_BYTES, Choices, Key
from jaxmark.watermark.coding.message import encode
from jaxmark.watermark.evidence.detection import weigh
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.mark import bind_mark
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.perception.budget import BudgetLike
from jaxmark.watermark.reading.detectors import claims
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, get_nonblind


class Search(NamedTuple):
    """The result of trying random keys."""

    key: Key  # the key with the strongest claim
    log10_p: Float64[np.ndarray, " keys"]  # of the claim with each key, see `Evidence`


def forge_original(
    given: Mesh, key: bytes, message: bytes, *, budget: BudgetLike = None, scheme: str | Scheme = DEFAULT_SCHEME
) -> Mesh:
    """Forge an original for a given mesh: the given mesh minus a mark that is made for it.

    This is the inversion attack of Craver, Memon, Yeo and Yeung, IEEE Journal on Selected Areas in Communications 16
    (1998). Here the mark must be made before the forged original exists, but its chips derive from that original's
    geometry.

    Args:
        given: a published mesh, marked by somebody else or not.
        key: the forger's key, 32 bytes.
        message: the forger's message.
        budget: see `embed`.
        scheme: see `make_marker`.

    Returns:
        The forged original, of which the given mesh would be the marked copy.

    Raises:
        JaxmarkError: see `embed`.
    """
    marker = make_marker(given, key, bits=8 * len(message), scheme=scheme)
    marked = marker.embed(message, budget, read_back=False)[0]
    return Mesh(2 * np.asarray(given.vertices, np.float64) - np.asarray(marked.vertices), marked.faces)


def search_key(
    given: Mesh, original: Mesh, message: bytes, keys: int, *, seed: int = 0, scheme: str | Scheme = DEFAULT_SCHEME
) -> Search:
    """Search random keys for the strongest claim on a mesh, with an original of the forger's choice.

    The mesh is aligned and received only once, because neither depends on the key. The claims of different keys are
    independent: at most keys · 10^-x of them are expected to reach a log10 p of -x.

    Args:
        given: a published mesh.
        original: the mesh that the forger presents as original; not the given mesh, or there is nothing to claim.
        message: the message that the forger claims to be in it.
        keys: number of keys to try, at least 1.
        seed: seed of the random keys.
        scheme: see `make_marker`.

    Raises:
        JaxmarkError: if `keys` is below 1, the original is unusable, or the given mesh cannot be aligned.
    """
    if keys < 1:
        raise JaxmarkError(f"A search takes at least 1 key, got {keys}.")
    maker, ready, random = get_nonblind(scheme), make_original(original), np.random.default_rng(seed)
    bits = 8 * len(message)
    code_bits, tried = maker.code_length(ready, bits), [Key(random.bytes(KEY_BYTES)) for _ in range(keys)]
    seen = observation(ready, align(ready, given))

    def choices(key: Key) -> Choices:
        return bind_mark(key, ready, maker, bits, "message")

    # What a reader forms and receives is free of the key.
    reader = maker.carrier(ready, choices(tried[0]), bits, code_bits).reader()
    received = reader.receive(seen)

    def claim_log10_p(key: Key) -> float:
        codeword = jnp.asarray(encode(message, choices(key), code_bits), ready.signal.dtype)
        other = reader.with_carrier(maker.carrier(ready, choices(key), bits, code_bits))
        ways = list(zip(*claims(other, received, codeword), strict=True))
        return weigh(ways, bits=bits, fixed=True).log10_p

    log10_p = np.array([claim_log10_p(key) for key in tried])
    return Search(tried[int(log10_p.argmin())], log10_p)


def transplant(marked: Mesh, estimate: Mesh, target: Mesh) -> Mesh:
    """Copy a mark to another mesh: add what a marked mesh has beyond an estimate of its original.

    This is the copy attack of Kutter, Voloshynovskiy and Herrigel, Security and Watermarking of Multimedia Contents II
    (2000).

    Args:
        marked: a marked mesh.
        estimate: an estimate of its original: the marked mesh smoothed by one of `ATTACKS`, or the original itself,
            which gives the whole mark.
        target: the mesh that the mark is copied to; any mesh of the same connectivity.

    Raises:
        JaxmarkError: if the three do not share their connectivity.
    """
    marked, estimate, target = map(host_mesh, (marked, estimate, target))
    if not all(same_connectivity(one, target) for one in (marked, estimate)):
        raise JaxmarkError("A mark is moved between meshes of one connectivity; these differ in theirs.")
    shift = np.asarray(marked.vertices) - np.asarray(estimate.vertices)
    return Mesh(np.asarray(target.vertices) + shift, target.faces)
