"""The displacements of the original's points, as far as a suspect shows them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Observation(NamedTuple):
    """Displacements and their weights. Weights and normals may depend on suspect and original, never on a key."""

    residual: Float[Array, "vertices 3"]  # displacement, in the units of the host's coordinates
    weights: Float[Array, " vertices"]  # relative inverse variance; 0 where nothing is known
    normals: Float[Array, "vertices 3"] | None = None  # if given, only components along these unit vectors are known
    nuisance: Float[Array, "vertices columns"] | None = None  # displacements that attacks on the host explain

    @property
    def observed(self) -> "Observation":
        """The suspect as it was given: this."""
        return self

    def channels(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices channels"]:
        """The known components of a displacement: all three, or the one along the normals."""
        return x if self.normals is None else jnp.sum(self.normals * x, axis=1, keepdims=True)

    def displacement(self, channels: Float[Array, "vertices channels"]) -> Float[Array, "vertices 3"]:
        """The adjoint of `channels`."""
        return channels if self.normals is None else self.normals * channels

    def weigh(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        """A displacement without its unknown components, multiplied by the weights."""
        return self.weights[:, None] * self.displacement(self.channels(x))


def observe(
    residual: Float[Array, "vertices 3"],
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Observation:
    """Make an observation; unless given, all weights are 1 and all components are known."""
    return Observation(residual, jnp.ones_like(residual[:, 0]) if weights is None else weights, normals)
