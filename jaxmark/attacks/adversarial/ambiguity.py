"""Attacks on what a detection says: claims on a mesh by somebody who did not mark it, and marks moved elsewhere."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark import evidence
from jaxmark.alignment import align, observation
from jaxmark.detectors import claims
from jaxmark.errors import JaxmarkError
from jaxmark.keys import KEY_BYTES, Key
from jaxmark.marking import make_marker
from jaxmark.mesh import Mesh, host_mesh, same_connectivity
from jaxmark.message import encode
from jaxmark.original import prepare
from jaxmark.schemes import DEFAULT_SCHEME, KeyedScheme, Scheme


class Search(NamedTuple):
    """What came of trying keys."""

    key: Key  # the one with the strongest claim
    log10_p: Float64[np.ndarray, " keys"]  # of the claim with each key, see `evidence.log10_p_claimed`


def forged_original(
    given: Mesh, key: bytes, message: bytes, *, budget: float | None = None, scheme: str | Scheme = DEFAULT_SCHEME
) -> Mesh:
    """An original of which a given mesh would be the marked one: the given mesh less a mark made for it.

    The inversion of Craver, Memon, Yeo and Yeung, IEEE Journal on Selected Areas in Communications 16 (1998). Here the
    mark must be made before the forged original is there, but its chips derive from that original's geometry.

    Args:
        given: a published mesh, marked by somebody else or not.
        key: the forger's, 32 bytes.
        message: the forger's.
        budget: see `embed`.
        scheme: see `make_marker`.

    Raises:
        JaxmarkError: as `embed`.
    """
    marker = make_marker(given, key, bits=8 * len(message), scheme=scheme)
    marked = marker.embed(message, budget, noise=0, read_back=False)[0]
    return Mesh(2 * np.asarray(given.vertices, np.float64) - np.asarray(marked.vertices), marked.faces)


def searched_key(
    given: Mesh, original: Mesh, message: bytes, keys: int, *, seed: int = 0, scheme: KeyedScheme | None = None
) -> Search:
    """Try random keys until one claims a mesh, with an original of the forger's choice.

    The mesh is aligned and received only once, for both are free of the key. Each key's claim is independent of all
    others': of so many keys, at most keys · 10^-x are expected to reach a log10 p of -x.

    Args:
        given: a published mesh.
        original: what the forger says it was made of; another mesh than the given one, or there is nothing to claim.
        message: what he says is in it.
        keys: how many are tried, at least 1.
        seed: of the keys.
        scheme: by default `KeyedScheme()`.

    Raises:
        JaxmarkError: if not even one key is to be tried, the original is unusable, or the given mesh cannot be aligned.
    """
    if keys < 1:
        raise JaxmarkError(f"A search takes at least 1 key, got {keys}.")
    scheme, ready, random = scheme or KeyedScheme(), prepare(original), np.random.default_rng(seed)
    bits = 8 * len(message)
    code, tried = scheme.code_length(ready, bits), [Key(random.bytes(KEY_BYTES)) for _ in range(keys)]
    first = scheme.carrier(ready, tried[0], bits, code)
    received = first.received(observation(ready, align(ready, given)))

    def claimed(key: Key) -> float:
        codeword = jnp.asarray(encode(message, key, ready.geometry, code), ready.signal.dtype)
        ways = zip(*claims(scheme.carrier(ready, key, bits, code), received, codeword), strict=True)
        return evidence.any_of(*(evidence.log10_p_claimed(score, norm) for score, norm in ways))

    log10_p = np.array([claimed(key) for key in tried])
    return Search(tried[int(log10_p.argmin())], log10_p)


def transplanted(marked: Mesh, estimate: Mesh, target: Mesh) -> Mesh:
    """Another mesh with what a marked one has beyond an estimate of its original.

    The copy attack of Kutter, Voloshynovskiy and Herrigel, Security and Watermarking of Multimedia Contents II (2000).

    Args:
        marked: a marked mesh.
        estimate: the same smoothed, by one of `ATTACKS`; or its original, which gives the whole mark.
        target: where the mark goes; any mesh of their connectivity.

    Raises:
        JaxmarkError: if the three do not share their connectivity.
    """
    marked, estimate, target = map(host_mesh, (marked, estimate, target))
    if not all(same_connectivity(one, target) for one in (marked, estimate)):
        raise JaxmarkError("A mark is moved between meshes of one connectivity; these differ in theirs.")
    shift = np.asarray(marked.vertices) - np.asarray(estimate.vertices)
    return Mesh(np.asarray(target.vertices) + shift, target.faces)
