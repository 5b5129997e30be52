"""Primitives of published methods: keyed bits, keyed random numbers, and the welded surface that is marked.

Most publications do not say how a key is used, or have no key. Here, every method permutes and flips the bits of its
message by a key, so that a wrong key decodes a message that is independent of the right one.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.special import ndtri

from jaxmark.bench.method import Bits, Reading
from jaxmark.geometry.mesh import Mesh, Weld, compact, host_mesh, used_vertices, weld, weld_mesh
from jaxmark.geometry.pose import Points
from jaxmark.watermark.coding.keys import Choices, Key

_CONFIDENT_QUANTILE = 0.25  # quantile of the margins that is the score; three bits in four have a larger margin


def choices(key: bytes, method: str) -> Choices:
    """Make the keyed random choices of a method."""
    return Choices(Key(key), f"bench/{method}".encode())


def scatter(message: Bits, key: bytes, method: str) -> Bits:
    """Permute the bits of a message by a key, and flip some of them."""
    order, flips = _placement(key, method, len(message))
    return np.asarray(message, bool)[order] ^ flips


def gather(written: Bits, key: bytes, method: str) -> Bits:
    """Invert `scatter`."""
    order, flips = _placement(key, method, len(written))
    return (written ^ flips)[np.argsort(order)]


def _placement(key: bytes, method: str, count: int) -> tuple[Int64[np.ndarray, " bits"], Bool[np.ndarray, " bits"]]:
    drawn = choices(key, method)
    return drawn.permutation("places", count), drawn.signs("flips", count) < 0


def decode_margins(margin: Float64[np.ndarray, " bits"], key: bytes, method: str) -> Reading:
    """Decode bits by the signs of their margins; the score is the margin that three bits in four exceed."""
    return Reading(gather(margin > 0, key, method), float(np.quantile(np.abs(margin), _CONFIDENT_QUANTILE)))


def uniform(key: bytes, method: str, label: str, count: int) -> Float64[np.ndarray, " count"]:
    """Draw independent numbers, uniform in the open interval (0, 1)."""
    words = np.frombuffer(choices(key, method).derive(label, 8 * count), "<u8")
    return ((words >> np.uint64(11)) + 0.5) / 2.0**53


def normal(key: bytes, method: str, label: str, count: int) -> Float64[np.ndarray, " count"]:
    """Draw independent standard normal numbers."""
    return ndtri(uniform(key, method, label, count))


class DistinctPoints(NamedTuple):
    """The distinct points of a mesh that faces use; for a cloud, all its points."""

    mesh: Mesh  # the points, and the faces between them
    given: Mesh  # the mesh before welding
    welded: Weld

    def moved(self, points: Points) -> Mesh:
        """Return the given mesh with its points moved; vertices of one point move together."""
        used = used_vertices(weld_mesh(self.given, self.welded))
        everywhere = np.array(self.given.vertices, np.float64)[self.welded.first]
        everywhere[used] = points
        return Mesh(everywhere[self.welded.point], self.given.faces)


def make_surface(mesh: Mesh) -> DistinctPoints:
    """Weld a mesh and remove unused vertices; raises as `jaxmark.geometry.mesh.make_mesh` does."""
    given = host_mesh(mesh)
    welded = weld(given.vertices)
    return DistinctPoints(compact(weld_mesh(given, welded)), given, welded)


def per_point(mesh: Mesh, values: Float64[np.ndarray, " faces"]) -> Float64[np.ndarray, " points"]:
    """Distribute the values of faces to their corners, a third to each."""
    return np.bincount(np.ravel(mesh.faces), np.repeat(values / 3, 3), len(mesh.vertices))
