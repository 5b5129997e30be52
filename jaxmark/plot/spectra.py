"""Over frequency: what bands let through, what they hold of host, mark and attacks, and what of it is seen."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float64
from numpy.polynomial import chebyshev

from jaxmark import visibility
from jaxmark.bands import nodes, scaling
from jaxmark.channels import band_energies
from jaxmark.distortion import Metric, name_of
from jaxmark.mesh import Mesh
from jaxmark.original import Original, residual
from jaxmark.plot.figures import FIELD, Picture, finish, panels, styles

_FREQUENCY = "frequency λ, from 0, smooth, to 2"


def responses(families: Mapping[str, Float[np.ndarray, "bands terms"]], mark: Sequence[float] = ()) -> Picture:
    """The responses of families of bands over λ, a panel a family; the lowest bands are dark, the highest bright.

    Args:
        families: Chebyshev coefficients (see `jaxmark.bands`) by the panels' titles.
        mark: values of λ for vertical lines, such as the edges between bands.

    Raises:
        JaxmarkError: if matplotlib is missing.
    """
    figure, axes = panels(len(families), 4.5, 3.5, sharey=True)
    from matplotlib import colormaps

    for panel, (name, family) in zip(axes, families.items(), strict=True):
        # Dense at the ends, where bands are narrow: 8 points a term.
        grid = 1 - np.cos(np.linspace(0, np.pi, 8 * max(64, family.shape[1]) + 1))
        for place, response in enumerate(chebyshev.chebval(grid - 1, np.asarray(family, np.float64).T)):
            panel.plot(grid, response, color=colormaps[FIELD](place / max(1, len(family) - 1)), linewidth=1)
        for place in mark:
            panel.axvline(place, color="grey", linewidth=0.5)
        finish(panel, title=name, xlabel=_FREQUENCY, ylabel="response f(λ)")
    return Picture(figure)


def spectra(original: Original, moves: Mapping[str, tuple[Mesh, Mesh]], bands: int = 64) -> Picture:
    """How much of the host, and of what moved it, lies in each of some Jackson-damped scaling functions.

    A point is the mean square of a vertex's displacement in the band; of the host, from its centre.

    Args:
        original: the original.
        moves: meshes before and after, by what was done: original and marked one, marked and attacked one. All of the
            original's connectivity, in its pose.
        bands: how many.

    Raises:
        JaxmarkError: if matplotlib is missing, or a connectivity differs.
    """
    signals = {"host": original.on_host(original.signal)}
    for name, (before, after) in moves.items():
        signals[name] = residual(original, after) - residual(original, before)
    figure, (axes,) = panels(1, 6.5, 4.2)
    for (name, signal), style in zip(signals.items(), styles(bands), strict=False):
        axes.plot(nodes(bands), mean_squares(original, signal, bands), label=name, **style)
    finish(axes, xlabel=_FREQUENCY, ylabel="mean square in the band / diagonal²", yscale="log")
    return Picture(figure)


def mean_squares(
    original: Original, signal: Float64[np.ndarray, "points 3"], bands: int
) -> Float64[np.ndarray, " bands"]:
    """The mean square, over vertices that faces use, of what each band holds of a displacement (in diagonals).

    Vertices are weighed by valence, as the bands' inner product does. What is rounding is left out, as NaN.
    """
    family, x = jnp.asarray(scaling(bands, damping="jackson"), original.signal.dtype), original.traced(signal)
    energies = np.asarray(band_energies(original.operator, family, x, x), np.float64)
    floor = 10 * float(np.finfo(original.signal.dtype).eps) * energies.sum() / bands
    return np.where(energies > floor, energies, np.nan) / original.used.sum()


def band_visibility(original: Original, metrics: Sequence[Metric], bands: int = 64) -> Picture:
    """How far metrics rise for a unit of displacement in each band (`jaxmark.visibility.band_visibility`).

    Args:
        original: the original.
        metrics: names in `distortion.METRICS`, or functions of your own.
        bands: how many Jackson-damped scaling functions.

    Raises:
        JaxmarkError: if matplotlib is missing, or see `distortion.measure`.
    """
    found = visibility.band_visibility(original, scaling(bands, damping="jackson"), metrics)
    figure, (axes,) = panels(1, 6.5, 4.2)
    for name, row, style in zip(metrics, found, styles(bands), strict=False):
        axes.plot(nodes(bands), row, label=name_of(name), **style)
    finish(axes, xlabel=_FREQUENCY, ylabel="metric / (RMS displacement / diagonal)", yscale="log")
    return Picture(figure)
