"""The observation of a suspect: the known displacements of the original's points, and their weights."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Observation(NamedTuple):
    """Displacements of the original's points, with their weights.

    Weights and normals may depend on suspect and original, never on a key.
    """

    residual: Float[Array, "vertices 3"]  # displacement, in the units of the host's coordinates
    weights: Float[Array, " vertices"]  # relative inverse variance; 0 for unknown displacements
    normals: Float[Array, "vertices 3"] | None = None  # if given, only components along these unit vectors are known
    nuisance: Float[Array, "vertices columns"] | None = None  # displacements that attacks on the host explain

    @property
    def observed(self) -> "Observation":
        """The observation before any preparation for a detector: the object itself."""
        return self

    def channels(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices channels"]:
        """Return the known components of a displacement: all three, or the component along the normals."""
        return x if self.normals is None else jnp.sum(self.normals * x, axis=1, keepdims=True)

    def displacement(self, channels: Float[Array, "vertices channels"]) -> Float[Array, "vertices 3"]:
        """Apply the adjoint of `channels`."""
        return channels if self.normals is None else self.normals * channels

    def weigh(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        """Set the unknown components of a displacement to 0, and multiply it by the weights."""
        return self.weights[:, None] * self.displacement(self.channels(x))


def observe(
    residual: Float[Array, "vertices 3"],
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Observation:
    """Make an observation; by default, all weights are 1 and all components are known."""
    return Observation(residual, jnp.ones_like(residual[:, 0]) if weights is None else weights, normals)
