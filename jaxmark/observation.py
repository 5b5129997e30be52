"""What a suspect shows of how each point of the original was moved."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Observation(NamedTuple):
    """Displacements with what each is worth. Weights and normals may depend on suspect and original, never on a key."""

    residual: Float[Array, "vertices 3"]  # in the units of the host's coordinates
    weights: Float[Array, " vertices"]  # relative inverse variance; 0 where nothing is known
    normals: Float[Array, "vertices 3"] | None = None  # given, only the component along these unit vectors is known
    nuisance: Float[Array, "vertices columns"] | None = None  # what the suspect shows the host to have gone through

    def channels(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices channels"]:
        """The components of a displacement that can be seen: three, or one along the normals."""
        return x if self.normals is None else jnp.sum(self.normals * x, axis=1, keepdims=True)

    def displacement(self, channels: Float[Array, "vertices channels"]) -> Float[Array, "vertices 3"]:
        """The adjoint of `channels`."""
        return channels if self.normals is None else self.normals * channels

    def weigh(self, x: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        """A displacement with what cannot be seen left out, and the rest by its weight."""
        return self.weights[:, None] * self.displacement(self.channels(x))


def observe(
    residual: Float[Array, "vertices 3"],
    weights: Float[Array, " vertices"] | None = None,
    normals: Float[Array, "vertices 3"] | None = None,
) -> Observation:
    """An observation in which, unless told otherwise, everything is seen and equally good."""
    return Observation(residual, jnp.ones_like(residual[:, 0]) if weights is None else weights, normals)
