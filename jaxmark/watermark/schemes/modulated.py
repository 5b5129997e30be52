"""Schemes that modulate components of the original: the paper's and Ohbuchi's."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from jaxmark.alignment.original import Original
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark.carriers.components import Components, eigenspaces, host_bands
from jaxmark.watermark.carriers.modulation import ModulatedCarrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.coding.sequences import orthogonal_sequences
from jaxmark.watermark.interfaces import Carrier, Scheme


class ModulatedScheme(Scheme):
    """A scheme that writes on components of the host, with a keyed sign for each component, coordinate and code bit."""

    @property
    def count(self) -> int:
        """The number of components that the scheme uses; a small mesh may have fewer."""
        raise NotImplementedError

    def components(self, original: Original) -> Components:
        """Split an original into its components."""
        raise NotImplementedError

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; the more code bits share the components, the more they interfere with each other."""
        return code_length(bits, 3 * self.count, 2)

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> Carrier:
        """See `Scheme`; each bit has a keyed sequence over all pairs of a component and a coordinate."""
        components = self.components(original)
        sequences = orthogonal_sequences(choices, code_bits, 3 * self.count, label=self.name)
        sequences = sequences.reshape(code_bits, self.count, 3)
        return ModulatedCarrier(components, np.ascontiguousarray(sequences[:, : components.gram.shape[-1]]))


@dataclass(frozen=True)
class HostScheme(ModulatedScheme):
    """The paper's scheme, which writes on polynomial bands of the host, with a keyed sign for each band and coordinate.

    The defaults are the variant that works: Jackson-damped bands at unit norm. `kernel="printed", damping="none",
    unit_norm=False` is the variant that the paper prints; with it, the components of natural meshes are nearly
    collinear. The signs need a Hadamard matrix of order 3 · bands, which exists if `bands` is a power of two from 4
    on, and for some other numbers.
    """

    name: ClassVar[str] = "host"
    bands: int = 128  # number of bands
    kernel: Literal["halved", "printed"] = "halved"  # kernel of the bands, see `jaxmark.spectral.bands`
    damping: Literal["none", "jackson", "lanczos"] = "jackson"  # damping of the bands
    unit_norm: bool = True  # whether components are scaled to unit norm

    @property
    def count(self) -> int:
        """See `ModulatedScheme`."""
        return self.bands

    def components(self, original: Original) -> Components:
        """See `ModulatedScheme`."""
        family = scaling(self.bands, kernel=self.kernel, damping=self.damping)
        return host_bands(original.operator, original.signal, family, unit_norm=self.unit_norm)


@dataclass(frozen=True)
class EigenScheme(ModulatedScheme):
    """Ohbuchi's scheme, which writes on the lowest eigenpairs of the Laplacian, with a keyed sign per coordinate.

    `pairs` can be the same numbers as `HostScheme.bands`.
    """

    name: ClassVar[str] = "eigen"
    pairs: int = 64  # number of eigenpairs

    @property
    def count(self) -> int:
        """See `ModulatedScheme`."""
        return self.pairs

    def components(self, original: Original) -> Components:
        """See `ModulatedScheme`."""
        return eigenspaces(original.operator, original.signal, eigenpairs(original.operator, self.pairs))
