"""Attacks on the proof: claims on a mesh by an adversary who did not mark it, and marks copied to other meshes."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxmark.alignment.attempts import align
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
    """The result of a search over random keys."""

    key: Key  # the key with the strongest claim
    log10_p: Float64[np.ndarray, " keys"]  # log10 p of the claim with each key, see `Evidence`


def forge_original(
    given: Mesh, key: bytes, message: bytes, *, budget: BudgetLike = None, scheme: str | Scheme = DEFAULT_SCHEME
) -> Mesh:
    """Forge an original for a given mesh: the given mesh minus a mark that is made for it.

    This is the inversion attack of Craver, Memon, Yeo and Yeung, IEEE Journal on Selected Areas in Communications 16
    (1998). Here the mark must be made before the forged original exists, but its chips derive from that original's
    geometry. The given mesh would be the marked copy of the forged original that is returned. Key and message are the
    forger's; they, `budget`, `scheme` and errors are those of `embed`.
    """
    marker = make_marker(given, key, bits=8 * len(message), scheme=scheme)
    marked = marker.embed(message, budget, read_back="never")[0]
    return Mesh(2 * np.asarray(given.vertices, np.float64) - np.asarray(marked.vertices), marked.faces)


def search_key(
    given: Mesh, original: Mesh, message: bytes, keys: int, *, seed: int = 0, scheme: str | Scheme = DEFAULT_SCHEME
) -> Search:
    """Search random keys for the strongest claim on a mesh, with an original of the forger's choice.

    The mesh is aligned and received only once, because neither depends on the key. The claims of different keys are
    independent: at most keys · 10^-x of them are expected to reach a log10 p of -x. The original must differ from the
    given mesh, or there is nothing to claim.

    Raises:
        JaxmarkError: if `keys` is below 1, the original is unusable, or the given mesh cannot be aligned.
    """
    if keys < 1:
        raise JaxmarkError(f"A search takes at least 1 key, got {keys}.")
    maker, ready, random = get_nonblind(scheme), make_original(original), np.random.default_rng(seed)
    bits, candidates = 8 * len(message), [Key(random.bytes(KEY_BYTES)) for _ in range(keys)]
    code_bits, observation = maker.code_length(ready, bits), align(ready, given).observation(ready)

    def choices(key: Key) -> Choices:
        return bind_mark(key, ready, maker, bits, "message")

    # Reader and reception are independent of the key.
    reader = maker.carrier(ready, choices(candidates[0]), bits, code_bits).reader()
    received = reader.receive(observation)

    def claim_log10_p(key: Key) -> float:
        codeword = jnp.asarray(encode(message, choices(key), code_bits), ready.signal.dtype)
        other = reader.with_carrier(maker.carrier(ready, choices(key), bits, code_bits))
        ways = list(zip(*claims(other, received, codeword), strict=True))
        return weigh(ways, bits=bits, fixed=True).log10_p

    log10_p = np.array([claim_log10_p(key) for key in candidates])
    return Search(candidates[int(log10_p.argmin())], log10_p)


def transplant(marked: Mesh, estimate: Mesh, target: Mesh) -> Mesh:
    """Copy a mark to another mesh: add the difference of a marked mesh and an estimate of its original.

    This is the copy attack of Kutter, Voloshynovskiy and Herrigel, Security and Watermarking of Multimedia Contents II
    (2000). The estimate is the marked mesh smoothed by one of `ATTACKS`, or the original itself, which gives the whole
    mark.

    Raises:
        JaxmarkError: if the three meshes do not share their connectivity.
    """
    marked, estimate, target = map(host_mesh, (marked, estimate, target))
    if not all(same_connectivity(one, target) for one in (marked, estimate)):
        raise JaxmarkError("A mark can only be copied between meshes of one connectivity; these meshes differ in it.")
    shift = np.asarray(marked.vertices) - np.asarray(estimate.vertices)
    return Mesh(np.asarray(target.vertices) + shift, target.faces)
