"""Schemes that modulate components of the original: the paper's, and Ohbuchi's."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from jaxmark.alignment.original import Original
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark.carriers.components import Components, eigenspaces, host_bands
from jaxmark.watermark.carriers.modulated import ModulatedCarrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.coding.sequences import orthogonal_sequences
from jaxmark.watermark.interfaces import Carrier, Detector, Scheme
from jaxmark.watermark.reading.detectors import decorrelate


@dataclass(frozen=True)
class HostScheme(Scheme):
    """The paper's scheme: it writes on polynomial bands of the host, with a keyed sign for each band and coordinate.

    The defaults are the form of it that works: Jackson-damped bands at unit norm. `kernel="printed", damping="none",
    unit_norm=False` is the form that the paper prints, in which the components of natural meshes are nearly collinear.
    The signs need a Hadamard matrix of order 3 · bands, which exists if `bands` is a power of two from 4 on, and for
    some other numbers.
    """

    name: ClassVar[str] = "host"
    bands: int = 128  # number of bands
    kernel: Literal["halved", "printed"] = "halved"  # kernel of the bands, see `jaxmark.spectral.bands`
    damping: Literal["none", "jackson", "lanczos"] = "jackson"  # damping of the bands
    unit_norm: bool = True  # whether components are scaled to unit norm

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return decorrelate

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; the more code bits share the components, the more they interfere with each other."""
        return code_length(bits, 3 * self.bands, 2)

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> Carrier:
        """See `Scheme`."""
        family = scaling(self.bands, kernel=self.kernel, damping=self.damping)
        components = host_bands(original.operator, original.signal, family, unit_norm=self.unit_norm)
        return _make_modulated(self.name, components, self.bands, original, choices, code_bits)


@dataclass(frozen=True)
class EigenScheme(Scheme):
    """Ohbuchi's scheme: it writes on the lowest eigenpairs of the Laplacian, with a keyed sign for each and coordinate.

    The numbers that `pairs` may be are those of `HostScheme.bands`.
    """

    name: ClassVar[str] = "eigen"
    pairs: int = 64  # number of eigenpairs

    @property
    def detector(self) -> Detector:
        """See `Scheme`."""
        return decorrelate

    def code_length(self, original: Original, bits: int) -> int:
        """See `Scheme`; the more code bits share the components, the more they interfere with each other."""
        return code_length(bits, 3 * self.pairs, 2)

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> Carrier:
        """See `Scheme`."""
        pairs = eigenpairs(original.operator, self.pairs)
        components = eigenspaces(original.operator, original.signal, pairs)
        return _make_modulated(self.name, components, self.pairs, original, choices, code_bits)


def _make_modulated(
    name: str, components: Components, bands: int, original: Original, choices: Choices, code_bits: int
) -> ModulatedCarrier:
    """Modulate components by one keyed sequence per bit, which runs over all pairs of a band and a coordinate."""
    slots = 3 * bands
    sequences = orthogonal_sequences(choices, code_bits, slots, label=name).reshape(code_bits, bands, 3)
    used = components.gram.shape[-1]  # a small mesh has fewer eigenvectors than the layout has places for
    return ModulatedCarrier(components, np.ascontiguousarray(sequences[:, :used]))
