"""A mark as arrays: embedding and evidence as pure functions, for one key and suspect or for many at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.alignment.observation import observe
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.bits import best_evidence
from jaxmark.watermark.interfaces import Reader
from jaxmark.watermark.mark import Mark
from jaxmark.watermark.reading.detectors import claims

Coordinates = Float[Array, "rows 3"]


class MarkArrays(NamedTuple):
    """All arrays of a mark; a pytree, whose methods are pure functions for `jit`, `vmap` and `grad`.

    Lengths are in diagonals of the original's bounding box. Rows past the original's points pad the arrays, and never
    count. Pass the arrays to compiled functions as an argument: those that a function closes over are compiled into it.
    """

    x: Coordinates  # the original's points, each connected component about its own centre
    reader: Reader  # of the carrier, with everything that does not depend on the suspect
    codeword: Float[Array, " code"]  # the message and its tag, ±1
    moving: Float[Array, " rows"]  # 1 for points that faces use, else 0

    @property
    def carrier(self) -> Any:
        """The carrier, which maps code bits to displacements."""
        return self.reader.carrier

    def embed(self, rms: float | Float[Array, ""]) -> Coordinates:
        """Displace the original's points by the mark, with an RMS displacement of `rms` diagonals."""
        shift = self.carrier.displacement(self.codeword)
        size = jnp.sqrt(jnp.sum(self.moving[:, None] * shift**2) / jnp.sum(self.moving))
        return self.x + jnp.asarray(rms).astype(shift.dtype) / size * shift

    def receive(self, suspect: Coordinates, weights: Float[Array, " rows"] | None = None) -> Any:
        """Extract from a suspect all that does not depend on the key; see `jaxmark.watermark.interfaces.Reader`.

        Args:
            suspect: the suspect's points, in the order and pose of `x`.
            weights: relative inverse variance of each point; by default, all are equal.
        """
        return self.reader.receive(observe(suspect - self.x, self.moving if weights is None else weights))

    def claim(self, received: Any) -> Float[Array, ""]:
        """Compute the evidence for the message in nats, as `jaxmark.watermark.bits.log_evidence` does."""
        return best_evidence(*claims(self.reader, received, self.codeword))

    def evidence(self, suspect: Coordinates, weights: Float[Array, " rows"] | None = None) -> Float[Array, ""]:
        """Compute the evidence for the message in a suspect, in nats; see `receive` and `claim`."""
        return self.claim(self.receive(suspect, weights))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MarkBatch:
    """The arrays of one message in one original under several keys; arrays that no key decides are there once.

    It is a pytree, to be passed to compiled functions as an argument.
    """

    keyed: tuple[Array, ...]  # each with a leading axis of keys
    shared: tuple[Any, ...]
    structure: Any = field(metadata={"static": True})  # of a `MarkArrays`, and which of its leaves are keyed

    def first(self) -> MarkArrays:
        """Return the arrays of the first key, such as to `receive` a suspect, in which no key has a part."""
        return self._restore(tuple(leaf[0] for leaf in self.keyed))

    def map(self, function: Callable[[MarkArrays], Any], chunk: int = 64) -> Any:
        """Apply a pure function to the arrays of each key, and stack the results.

        Args:
            function: a function of `MarkArrays`, such as `lambda one: one.claim(received)`.
            chunk: number of keys that are computed at once, which limits the memory.
        """
        return jax.lax.map(lambda keyed: function(self._restore(keyed)), self.keyed, batch_size=chunk)

    def _restore(self, keyed: tuple[Array, ...]) -> MarkArrays:
        structure, is_keyed = self.structure
        ours, others = iter(keyed), iter(self.shared)
        return jax.tree.unflatten(structure, [next(ours if one else others) for one in is_keyed])


def make_arrays(mark: Mark, message: bytes) -> MarkArrays:
    """Gather the arrays of a mark that is read with the original, for one message."""
    dtype = mark.original.signal.dtype
    codeword = jax.device_put(mark.codeword(message).astype(dtype))
    moving = jax.device_put(np.asarray(mark.original.moving).astype(dtype))
    return MarkArrays(mark.original.signal, mark.reader, codeword, moving)


def make_batch(mark: Mark, message: bytes, keys: Sequence[bytes]) -> MarkBatch:
    """Gather the arrays of a mark under several keys, which replace the mark's own; on the host, key by key.

    Raises:
        JaxmarkError: if there is no key, or one is no key.
    """
    if not keys:
        raise JaxmarkError("A batch needs at least one key.")
    own = make_arrays(mark, message)
    reference, structure = jax.tree.flatten(own)
    differing: list[dict[int, Any]] = []  # for each key, its leaves that are not those of the mark's own key
    for key in keys:
        other = mark.make(mark.original, key, mark.scheme, mark.bits)
        codeword = other.codeword(message).astype(own.x.dtype)
        leaves = jax.tree.leaves(own._replace(reader=mark.reader.with_carrier(other.carrier), codeword=codeword))
        pairs = enumerate(zip(leaves, reference, strict=True))
        differing.append({k: leaf for k, (leaf, ref) in pairs if leaf is not ref and not np.array_equal(leaf, ref)})
    # All other arrays are those of the original and of the scheme. The codeword always counts as keyed, so that a batch
    # of the mark's own key alone knows its size.
    codeword = next(k for k, leaf in enumerate(reference) if leaf is own.codeword)
    is_keyed = [k == codeword or any(k in leaves for leaves in differing) for k in range(len(reference))]
    stacks = [np.stack([leaves.get(k, ref) for leaves in differing]) for k, ref in enumerate(reference) if is_keyed[k]]
    shared = tuple(ref for k, ref in enumerate(reference) if not is_keyed[k])
    return MarkBatch(tuple(jax.device_put(stacks)), shared, (structure, tuple(is_keyed)))
