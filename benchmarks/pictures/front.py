"""Draws the pictures of README, front page and gallery: python benchmarks/pictures/front.py [NAME ...].

Those are drawn whose sources have changed since, or that are named. The gallery's are thumbnails of what the notebooks
save, in `docs/notebooks`, where `make pictures` runs them before.
"""

import io
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageOps

import jaxmark as jm
from jaxmark import plot, spectral
from jaxmark.app.demo import sample_mesh
from jaxmark.evaluation import pictures
from jaxmark.geometry import asteroid

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser
from common.drawn import FOLDER, MOST_BYTES, ROOT, hashes, keep, known, small
from common.marks import KEY, MESSAGE
from common.tables import say

WIDTH, THUMBNAIL = 1250, (480, 240)  # pixels
RMS = 4e-4  # displacement over the diagonal of all three schemes in the picture of what survives
SAMPLES = 20
SHOWN = ("01_1", "02_1", "03_1", "04_1", "05_1", "06_1", "07_1", "08_1", "09_2", "10_1", "11_1", "12_1", "13_1")
ATTACKS = {"noise of 0.5 %": ("noise", 0.005), "smoothed 50 times": ("smoothing", 50)}


def demo() -> bytes:
    """A mesh, its marked copy, what was done to it, and attacked copies that are still read."""
    marker = jm.make_marker(jm.load_mesh(sample_mesh()), KEY, bits=8 * len(MESSAGE))
    marked, _ = marker.embed(MESSAGE)
    views = [
        plot.View("original", marker.original.mesh),
        plot.View("marked", marked),
        plot.exaggerate(marker.original, marked),
    ]
    for name, (kind, strength) in ATTACKS.items():
        suspect = jm.attack(marked, kind, strength, seed=0)
        found = marker.detect(suspect)
        read = "LOST" if found.message != MESSAGE else f"still read: “{MESSAGE.decode()}”"
        views.append(plot.View(f"{name}\n{read}", suspect))
    return narrow(plot.draw(views), 10.5, 2.9)


def survival() -> bytes:
    """How often three schemes are read in noise, at one displacement."""
    mesh, curves = asteroid(3000), {}
    for name, title in (("keyed", "default"), ("host", "Sohn et al."), ("eigen", "Ohbuchi et al.")):
        marker = jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE), scheme=name)
        marked, _ = marker.embed(MESSAGE, jm.Budget(rms=RMS, noise=0))
        strengths = [0.001, 0.002, 0.003, 0.004, 0.006, 0.008, 0.01, 0.012, 0.014, 0.016]
        curves[title] = jm.robustness(marker, marked, MESSAGE, "noise", strengths, samples=SAMPLES)
    return narrow(pictures.success(curves, f"noise, {jm.adversaries.ATTACKS['noise'].unit}"), 7.5, 3.2)


def bank() -> bytes:
    """A mesh, what its lowest wavelets are alone, and where others find something."""
    mesh = jm.load_mesh(sample_mesh())
    operator = spectral.from_mesh(mesh)
    x = jnp.asarray(spectral.centre(operator, mesh.vertices), jnp.float32)
    size = float(jnp.linalg.norm(jnp.ptp(x, axis=0)))
    parts = np.asarray(spectral.band_components(operator, spectral.bands.meyer(6), x), np.float64)
    coarse = mesh._replace(vertices=parts[:2].sum(axis=0))
    views = [plot.View("mesh", mesh), plot.View("bands 1 and 2 alone", coarse)]
    for band in (2, 4):
        found = 100 / size * np.linalg.norm(parts[band], axis=1)
        views.append(plot.View(f"band {band + 1}", mesh, np.minimum(found, np.quantile(found, 0.99)), "% of diagonal"))
    return narrow(plot.draw(views), 10.5, 2.9)


def narrow(picture: plot.Picture, width: float, height: float) -> bytes:
    """A picture of a size in inches in which its titles can be read on a page."""
    picture.figure.set_size_inches(width, height)
    for axes in picture.figure.axes:
        axes.title.set_fontsize(12)
    return picture.png()


def thumbnail(name: str) -> Callable[[], bytes]:
    """The thumbnail of a picture that a notebook has saved; all have one shape, so that cards stand in rows."""

    def draw() -> bytes:
        image = Image.open(ROOT / "docs" / "notebooks" / f"{name}.png").convert("RGB")
        buffer = io.BytesIO()
        ImageOps.pad(image, THUMBNAIL, Image.Resampling.LANCZOS, color="white").save(buffer, format="PNG")
        return small(buffer.getvalue(), THUMBNAIL[0])

    return draw


#: How each picture is drawn, by the name of its file.
PICTURES: Mapping[str, Callable[[], bytes]] = {
    **{f"{draw.__name__}.png": lambda draw=draw: small(draw(), WIDTH) for draw in (demo, survival, bank)},
    **{f"gallery_{name[:2]}.png": thumbnail(name) for name in SHOWN},
}


def main() -> None:
    """Draw what has changed."""
    parser = make_parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="pictures to draw anyway, such as demo.png")
    names = parser.parse_args().names
    if unknown := [name for name in names if name not in PICTURES]:
        parser.error(f"there is no picture {unknown[0]}; there are {', '.join(PICTURES)}")
    before = known()
    for name, draw in PICTURES.items():
        if name not in names and before.get(name) == hashes(name):
            continue
        png = draw()
        if len(png) > MOST_BYTES:
            parser.error(f"{name} has {len(png):,} bytes, more than {MOST_BYTES:,}")
        keep(FOLDER / name, png)
        say(f"{name}: {len(png) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
