"""Carriers that spread bits over keyed chips by a linear map of your own."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.seeds import Seed
from jaxmark.spectral.precision import sum_and_norm
from jaxmark.watermark.carriers.chips import Chips, make_chips
from jaxmark.watermark.carriers.modulation import PlainReader
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.interfaces import Claim, Detector, Displacement, Strength
from jaxmark.watermark.reading.detectors import correlate


class SpreadCarrier(NamedTuple):
    """A carrier w = β · shape(r) of keyed chips r[v, c] = s[v, c] · bit[slot(v, c)]; see `Carrier`.

    The map `shape` is all that you write; JAX transposes it for reading. Make the carrier by `make_spread_carrier`.
    Memory and time do not grow with the number of bits. With several chips for each bit, other bits act as noise, so
    bits are read by correlation.
    """

    shape: Any  # a linear map of chips `[N, channels]` to displacements `[N, 3]`; see `make_spread_carrier`
    chips: Chips
    signal: Float[Array, "vertices 3"]  # the original's, whose dtype the results have

    @property
    def code_bits(self) -> int:
        """See `Carrier`."""
        return len(self.chips.population)

    @property
    def detector(self) -> Detector:
        """See `Carrier`."""
        return correlate

    def displacement(self, bits: Float[Array, " bits"], beta: Strength = 1.0) -> Displacement:
        """See `Carrier`; β is one number."""
        return self._scaled(self.shape(self._spread(bits)), beta)

    def adjoint(self, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
        """See `Carrier`; for the plain inner product, in which all vertices weigh the same."""
        return self.chips.collect(self._match(self._scaled(residual, beta)))

    def gram(self, beta: Strength = 1.0) -> Float[Array, "bits bits"]:
        """See `Carrier`; needs two maps per bit, hence is meant for tests and small codes."""
        unit = jnp.eye(self.code_bits, dtype=self.signal.dtype)
        return jax.lax.map(lambda bits: self.adjoint(self.displacement(bits, beta), beta), unit)

    def claim(self, observation: Observation, bits: Float[Array, " bits"]) -> Claim:
        """See `Carrier`; each chip has a keyed sign."""
        return Claim(*sum_and_norm(self._spread(bits) * self._match(observation.weigh(observation.residual))))

    def redraw(self, seed: Seed) -> "SpreadCarrier":
        """See `Carrier`, and `Chips.redraw`."""
        return self._replace(chips=self.chips.redraw(seed))

    def reader(self) -> PlainReader:
        """See `Carrier`."""
        return PlainReader(self)

    def _spread(self, bits: Float[Array, " bits"]) -> Float[Array, "vertices channels"]:
        return self.chips.spread(bits, self.signal.dtype)

    def _match(self, residual: Displacement) -> Float[Array, "vertices channels"]:
        """Apply the transpose of the map."""
        chips = jax.ShapeDtypeStruct(self.chips.signs.shape, self.signal.dtype)
        (matched,) = jax.linear_transpose(self.shape, chips)(residual)
        return matched

    def _scaled(self, displacement: Displacement, beta: Strength) -> Displacement:
        return jnp.asarray(beta).astype(self.signal.dtype) * displacement


def make_spread_carrier(
    original: Original, choices: Choices, code_bits: int, shape: Any, *, channels: int = 3
) -> SpreadCarrier:
    """Make the carrier of a scheme of your own from a linear map.

    Args:
        original: the mesh to mark.
        choices: the keyed choices of the mark, which give the signs, and the bits that chips belong to.
        code_bits: number of code bits to carry.
        shape: a linear function of chips `[rows, channels]`, with a row for each of `original.signal`, to displacements
            `[rows, 3]`, **independent of the key**; as a pytree, such as `jax.tree_util.Partial(function, *arrays)`.
        channels: number of chips of each vertex.

    Raises:
        JaxmarkError: if there is no code bit or no channel, or the map is not linear or returns another shape.
    """
    if code_bits < 1 or channels < 1:
        raise JaxmarkError(f"A carrier needs code bits and channels, got {code_bits} and {channels}.")
    _check_map(shape, original.signal, channels)
    chips = make_chips(choices, original.chip_places, code_bits, channels=channels, count=original.count)
    return SpreadCarrier(shape, chips, original.signal)


def _check_map(shape: Any, signal: Float[Array, "rows 3"], channels: int) -> None:
    """Check the map of `make_spread_carrier`: JAX can transpose it, and it maps zero to zero displacements.

    Raises:
        JaxmarkError: if the map is not linear or returns another shape.
    """
    chips = jnp.zeros((len(signal), channels), signal.dtype)
    moved = shape(chips)
    if jnp.shape(moved) != signal.shape:
        raise JaxmarkError(
            f"The map of a carrier returns displacements of the shape {signal.shape}, one for each row of"
            f" `original.signal`; this one returns {jnp.shape(moved)}."
        )
    try:
        jax.eval_shape(jax.linear_transpose(shape, chips), moved)
    except NotImplementedError:
        moved = None
    if moved is None or (moved != 0).any():
        raise JaxmarkError(
            "The map of a carrier must be a linear function of the chips, such as a filter, a matrix or products with"
            " constants; this one is not."
        )
