"""Metrics of rendered pictures: pictures of two meshes, compared by metrics of images.

Both meshes are rendered from six sides, with three lights, and with flat and smooth shading. One of the lights grazes
the surfaces that face the viewer. These metrics are slow, and depend on sides and lights; they serve to check the
metrics of the surface.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64

from jaxmark.errors import require
from jaxmark.geometry.mesh import Mesh, host_mesh
from jaxmark.geometry.raster import SIDES, Frame, Raster, cast

SIZE = 384  # pixels on each side of a picture
_MARGIN = 12  # pixels kept around the object
_PERCENTILE = 99
_INCIDENCES, _TURNS = np.radians([30.0, 60.0, 80.0]), np.radians([135.0, 20.0, 250.0])  # of lights, from the eye's axis
#: Directions of the lights in the camera's: right, up, towards the eye.
LIGHTS = np.stack(
    [np.sin(_INCIDENCES) * np.cos(_TURNS), np.sin(_INCIDENCES) * np.sin(_TURNS), np.cos(_INCIDENCES)], axis=1
)

Gray = Float64[np.ndarray, "rows columns"]


class Difference(NamedTuple):
    """How different pictures are, over all pixels that show the object in either."""

    mean: float
    high: float  # the 99th percentile


def flip(original: Mesh, distorted: Mesh, size: int = SIZE) -> Difference:
    """Compare pictures of two meshes in the same place by FLIP, 0 to 1: the difference seen when they are alternated.

    Reference: Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild, "FLIP: a difference evaluator for
    alternating images", Proceedings of the ACM on Computer Graphics and Interactive Techniques 3(2), 2020, by the
    authors' program, for 67 pixels per degree. Pictures have `size` pixels on each side.

    Raises:
        JaxmarkError: if flip-evaluator or libigl is missing.
    """
    program = require("flip_evaluator", "render")

    def compared(first: Gray, second: Gray) -> Float32[np.ndarray, "rows columns"]:
        colours = (np.repeat(picture[:, :, None], 3, axis=2).astype(np.float32) for picture in (first, second))
        return program.evaluate(*colours, "LDR", applyMagma=False, computeMeanError=False)[0][:, :, 0]

    return _compare(original, distorted, size, compared)


def ssim(original: Mesh, distorted: Mesh, size: int = SIZE) -> Difference:
    """Compare pictures of two meshes in the same place by structural similarity: 1 - SSIM, 0 for equal pictures.

    Reference: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural
    similarity", IEEE Transactions on Image Processing 13(4), 2004, with its Gaussian windows, by scikit-image. Pictures
    have `size` pixels on each side.

    Raises:
        JaxmarkError: if scikit-image or libigl is missing.
    """
    metrics = require("skimage.metrics", "render")

    def compared(first: Gray, second: Gray) -> Gray:
        _, similar = metrics.structural_similarity(
            first, second, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, full=True
        )
        return 1 - similar

    return _compare(original, distorted, size, compared)


def lambert(raster: Raster, light: Float64[np.ndarray, "3"], *, smooth: bool) -> Gray:
    """Shade a picture by Lambert's law, as values for a screen (sRGB); black where no light falls, or no object is.

    `light` is the unit vector to the light, in the camera's directions. Smooth shading interpolates normals between
    vertices.
    """
    linear = np.clip(raster.normals(smooth=smooth) @ light, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _compare(original: Mesh, distorted: Mesh, size: int, compared: Callable[[Gray, Gray], np.ndarray]) -> Difference:
    found = [compared(*pictures)[shown] for shown, *pictures in _pictures(original, distorted, size)]
    values = np.concatenate(found).astype(np.float64)
    if not len(values):
        return Difference(0.0, 0.0)
    return Difference(float(values.mean()), float(np.percentile(values, _PERCENTILE)))


def _pictures(original: Mesh, distorted: Mesh, size: int) -> Iterator[tuple[np.ndarray, Gray, Gray]]:
    """Yield the mask of the pixels that show the object, and pictures of both meshes, for each side.

    The pictures of all lights, flat and smooth, are joined to one picture, because the metrics take long to start.
    """
    meshes = host_mesh(original), host_mesh(distorted)
    frame = Frame.of(meshes[0])
    for camera in SIDES.values():
        rasters = [cast(mesh, camera, frame, size) for mesh in meshes]
        shown = rasters[0].shown | rasters[1].shown
        part = _around(shown)
        ways = [(light, smooth) for light in LIGHTS for smooth in (False, True)]
        first, second = (
            np.hstack([lambert(raster, light, smooth=smooth)[part] for light, smooth in ways]) for raster in rasters
        )
        yield np.hstack([shown[part]] * len(ways)), first, second


def _around(shown: Bool[np.ndarray, "rows columns"]) -> tuple[slice, ...]:
    """Crop a picture to the object, with a margin for the filters of metrics."""
    parts = (np.append(np.flatnonzero(shown.any(axis=axis)), [] if shown.any() else [0]) for axis in (1, 0))
    return tuple(slice(max(int(part[0]) - _MARGIN, 0), int(part[-1]) + _MARGIN + 1) for part in parts)
