"""How visible a displacement is in each band."""

from collections.abc import Sequence

from jaxmark.alignment.original import Original
from jaxmark.distortion import Metric, name_of
from jaxmark.plot._spectra import FREQUENCY
from jaxmark.plot.figures import Picture, finish, panels, styles
from jaxmark.spectral.bands import nodes, scaling
from jaxmark.watermark.perception.visibility import band_visibility as measure_visibility


def band_visibility(original: Original, metrics: Sequence[Metric], bands: int = 64) -> Picture:
    """Plot how far metrics rise per unit of displacement in each band.

    The values are those of `jaxmark.watermark.perception.visibility.band_visibility`.

    Args:
        original: the original.
        metrics: names in `distortion.METRICS`, or functions of your own.
        bands: number of Jackson-damped scaling functions.

    Raises:
        JaxmarkError: if matplotlib is missing, or a metric is refused (see `distortion.measure`).
    """
    found = measure_visibility(original, scaling(bands, damping="jackson"), metrics)
    figure, (axes,) = panels(1, 6.5, 4.2)
    for name, row, style in zip(metrics, found, styles(bands), strict=False):
        axes.plot(nodes(bands), row, label=name_of(name), **style)
    finish(axes, xlabel=FREQUENCY, ylabel="metric / (RMS displacement / diagonal)", yscale="log")
    return Picture(figure)
