"""Draw the pictures of README, front page and gallery: python benchmarks/pictures/front.py [NAME ...].

It draws the named pictures, and all whose sources have changed. The pictures of the gallery are thumbnails of those
that the notebooks save in `docs/notebooks`; `make pictures` runs the notebooks first.
"""

import csv
import io
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageOps

import jaxmark as jm
from jaxmark import plot, spectral
from jaxmark.app.demo import sample_mesh
from jaxmark.plot.figures import panels

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser
from common.drawn import FOLDER, MOST_BYTES, ROOT, hashes, keep, known, small
from common.marks import KEY, MESSAGE
from common.tables import say

WIDTH, THUMBNAIL = 1250, (480, 240)  # pixels
PUBLISHED = ROOT / "docs" / "results" / "benchmark.csv"
#: Methods and attacks of the picture of the benchmark, by their names there.
METHODS = {
    "keyed": "jaxmark (default)",
    "eigen": "Ohbuchi et al. 2001",
    "praun": "Praun et al. 1999",
    "host": "Sohn et al.",
    "wang": "Wang et al. 2011, blind",
    "radial": "Rolland-Nevière et al. 2014, blind",
    "cho": "Cho et al. 2007, blind",
}
CELLS = {
    "none": "no attack",
    "noise 0.003": "noise 0.3 %",
    "quantisation 8": "quantised to 8 bits",
    "Draco 11": "Draco, 11 bits",
    "smoothing 10": "10 smoothing steps",
    "smoothing 50": "50 smoothing steps",
    "cropping 0.5": "half cut away",
    "simplification 0.5": "half of the edges collapsed",
    "loop 1": "Loop subdivision",
    "isotropic 1": "isotropic remeshing",
    "iso-surface 150": "iso-surface extraction",
    "bending 10": "bent by 10 degrees",
    "overwritten": "re-watermarked",
    "poisson 6": "Poisson reconstruction",
    "warp 0.02": "smooth warp of 2 %",
    "simplification 0.9": "90 % collapsed",
}
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


def methods() -> bytes:
    """How often methods decode 64 bits after attacks, within the same limits: cells of the published benchmark."""
    read = defaultdict(list)
    for row in csv.DictReader(PUBLISHED.read_text().splitlines()):
        if row["limits"] in ("perceptual", "hidden"):
            read[row["method"], row["attack"]].append(float(row["read"]))
    share = np.array([[np.mean(read[method, attack]) for attack in CELLS] for method in METHODS])
    figure, (panel,) = panels(1, 10.5, 4.2)
    panel.imshow(share, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for row, column in np.ndindex(share.shape):
        value = share[row, column]
        style = {"ha": "center", "va": "center", "color": "black" if value > 0.5 else "white"}
        panel.text(column, row, f"{100 * value:.0f}", **style)
    panel.set_xticks(range(len(CELLS)), CELLS.values(), rotation=40, ha="right", rotation_mode="anchor")
    panel.set_yticks(range(len(METHODS)), METHODS.values())
    panel.tick_params(length=0)
    return plot.Picture(figure).png()


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
    **{f"{draw.__name__}.png": lambda draw=draw: small(draw(), WIDTH) for draw in (demo, methods, bank)},
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
