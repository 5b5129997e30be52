"""Pictures show the right numbers: lines, shades and colours against what is computed here."""

import base64
import html
import re
import sys

import numpy as np
import pytest
import trimesh
from scipy import stats

import jaxmark as jm
from jaxmark import plot
from jaxmark.alignment.original import Original, displace, make_original
from jaxmark.evaluation import Robustness, pictures
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.plot.meshes import roughness_masking
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.spectrum import eigenpairs
from jaxmark.watermark.evidence.bounds import log10_p_score
from jaxmark.watermark.evidence.ledger import MIN_LOG10_P
from tests.samples import FINE, bumpy_sphere

matplotlib = pytest.importorskip("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def pair() -> tuple[Original, Mesh]:
    """An original, and a mesh moved from it."""
    original = make_original(bumpy_sphere(2))
    return original, displace(original, 1e-3 * np.random.default_rng(0).normal(size=original.positions.shape))


def lines(picture: plot.Picture, panel: int = 0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What a panel draws, by the legend's names."""
    drawn = picture.figure.axes[panel].lines
    return {line.get_label(): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in drawn}


def labels(picture: plot.Picture, panel: int = 0) -> tuple[str, str]:
    axes = picture.figure.axes[panel]
    return axes.get_xlabel(), axes.get_ylabel()


def test_heat_maps_of_displacement_and_visibility(pair):
    original, moved = pair
    vertices = np.asarray(original.mesh.vertices)
    diagonal = np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0))
    expected = 100 * np.linalg.norm(moved.vertices - vertices, axis=1) / diagonal
    view = plot.displacement(original, moved)
    np.testing.assert_allclose(view.values, expected, rtol=1e-9)
    assert view.unit == "% of diagonal"
    seen = plot.visibility(original, moved)
    hidden = np.asarray(roughness_masking(original), float)[original.weld.point]
    np.testing.assert_allclose(seen.values * hidden, expected, rtol=1e-6)
    far = plot.exaggerate(original, moved, 3)
    np.testing.assert_allclose(far.mesh.vertices - vertices, 3 * (moved.vertices - vertices), rtol=1e-9)
    picture = plot.draw([view, seen, far])
    assert [axes.get_title() for axes in picture.figure.axes[:3]] == [
        "displacement",
        seen.title,
        "3 × the displacement",
    ]
    bars = picture.figure.axes[3:]
    assert [bar.get_ylabel() for bar in bars] == ["% of diagonal"] * 2
    assert bars[0].get_ylim() == pytest.approx((0, expected.max()))


def test_a_heat_map_of_what_is_seen_of_normals(pair):
    original, moved = pair[0].mesh, pair[1]
    view = plot.shading(original, moved)
    assert view.unit == "just noticeable differences"
    corners = np.ravel(original.faces)
    soup, moved_soup = (
        make_mesh(mesh.vertices[corners], np.arange(len(corners)).reshape(-1, 3)) for mesh in (original, moved)
    )
    np.testing.assert_allclose(plot.shading(soup, moved_soup).values, np.asarray(view.values)[corners], rtol=1e-3)
    stray = [make_mesh(np.vstack([mesh.vertices, [[9.0, 9, 9]]]), mesh.faces) for mesh in (original, moved)]
    values = np.asarray(view.values)
    np.testing.assert_allclose(plot.shading(*stray).values, [*values, 0], rtol=1e-3)
    assert 0 < values.min() < jm.compare(original, moved, ["shading"]).shading < values.max() * 1.5
    with pytest.raises(jm.JaxmarkError, match="same connectivity"):
        plot.shading(original, bumpy_sphere(1))


def test_stripes_move_by_twice_the_turn_of_a_mirror(tmp_path):
    """A plane is plain; turned by the width of half a stripe, it shows the next one."""
    pytest.importorskip("igl")
    plane = make_mesh([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    found = {}
    for turn in (0.0, 3.75, 7.5):  # a stripe and the next are 15° long, in a mirror half of that
        image = plot.render(plot.Rendering("", plane, "zebra", (turn, 0.0)), 24)
        found[turn] = image[12, 12]
        np.testing.assert_allclose(image[image < 1], found[turn], atol=1e-6)
    assert found[3.75] < 0.3 < 0.9 < found[0.0] == pytest.approx(found[7.5], abs=0.05)
    front, tilted = (plot.render(plot.Rendering("", plane, "flat", side), 24) for side in ("front", (0.0, 0.0)))
    np.testing.assert_allclose(front, tilted)
    plot.draw_renderings([plot.Rendering("a plane", plane, "zebra")], 32).save(tmp_path / "zebra.png")
    assert (tmp_path / "zebra.png").read_bytes().startswith(PNG)
    with pytest.raises(jm.JaxmarkError, match="no side 'inside'"):
        plot.render(plot.Rendering("", plane, side="inside"))


def test_faces_are_painted_from_back_to_front_in_their_colours():
    near, far = [[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 0, -1], [1, 0, -1], [0, 1, -1]]
    mesh = jm.make_mesh(np.array(near + far, float), np.array([[0, 1, 2], [3, 4, 5]]))
    picture = plot.draw([plot.View("two", mesh, np.array([1.0, 1, 1, 0, 0, 0]))], elevation=0, azimuth=0)
    behind, before = picture.figure.axes[0].collections[0].get_facecolors()[:, :3]
    # Both face the eye alike, and are shaded alike.
    first, last = (np.array(matplotlib.colormaps["cividis"](value)[:3]) for value in (0.0, 1.0))
    shade = before / last
    np.testing.assert_allclose(shade, shade[0])
    np.testing.assert_allclose(behind, shade * first, rtol=1e-6)


@pytest.mark.usefixtures("x64")
def test_spectra_are_sums_over_eigenvectors():
    original = make_original(bumpy_sphere(2), FINE)
    rng = np.random.default_rng(0)
    shifts = 1e-3 * rng.normal(size=(2, *original.positions.shape))
    marked, suspect = displace(original, shifts[0]), displace(original, shifts.sum(axis=0))
    picture = plot.spectra(original, {"mark": (original.mesh, marked), "attack": (marked, suspect)}, 16)
    drawn = lines(picture)
    assert list(drawn) == ["host", "mark", "attack"]
    values, vectors, _ = eigenpairs(original.operator)
    mass = np.asarray(original.operator.degree, float)
    angles, count = np.arccos(values - 1), original.used.sum()
    for signal, (x, y) in zip((original.positions, *shifts), drawn.values(), strict=True):
        filled = np.zeros((len(mass), 3))
        filled[: len(signal)] = signal
        amplitudes = vectors.T @ (mass[:, None] * filled)  # of eigenvectors, without the mean
        response = scaling(16, damping="jackson") @ np.cos(np.arange(16)[:, None] * angles)
        energies = response @ (amplitudes**2).sum(axis=1)
        mean = (mass[:, None] * filled).sum(axis=0) ** 2 / mass.sum()
        at_zero = scaling(16, damping="jackson") @ np.cos(np.arange(16) * np.pi)
        shown = y * count * mass.sum() / np.count_nonzero(mass)
        expected = energies + at_zero * (0 if signal is original.positions else mean.sum())
        np.testing.assert_allclose(shown, expected, rtol=1e-6, atol=1e-9 * expected.sum())
        np.testing.assert_allclose(x, 1 - np.cos((np.arange(16) + 0.5) * np.pi / 16), rtol=1e-12)
    assert labels(picture) == ("frequency λ, from 0, smooth, to 2", "mean square in the band / diagonal²")
    assert picture.figure.axes[0].get_yscale() == "log"


def test_responses_are_the_chebyshev_series():
    families = {"plain": scaling(5), "damped": scaling(7, damping="jackson")}
    picture = plot.responses(families, mark=[0.5])
    for panel, (name, family) in enumerate(families.items()):
        axes = picture.figure.axes[panel]
        assert axes.get_title() == name
        assert len(axes.lines) == len(family) + 1
        for line, coefficients in zip(axes.lines, family, strict=False):
            angle = np.arccos(np.clip(line.get_xdata() - 1, -1, 1))
            expected = sum(c * np.cos(k * angle) for k, c in enumerate(coefficients))
            np.testing.assert_allclose(line.get_ydata(), expected, atol=1e-12)
        np.testing.assert_array_equal(axes.lines[-1].get_xdata(), [0.5, 0.5])
    assert labels(picture, 1)[1] == "response f(λ)"


def test_band_visibility_of_the_displacement_itself_is_one(pair):
    picture = pictures.band_visibility(pair[0], ["rms", "gl"], 8)
    drawn = lines(picture)
    np.testing.assert_allclose(drawn["rms"][1], 1, rtol=1e-3)
    assert (np.diff(drawn["gl"][1])[:5] > 0).all()  # it grows with frequency, where the sphere has any
    assert "diagonal" in labels(picture)[1]


def test_roc_counts_what_is_below_each_probability():
    rng = np.random.default_rng(0)
    kinds = {"marked": -rng.uniform(0, 12, 40), "wrong key": np.log10(rng.uniform(size=300))}
    picture = pictures.roc(kinds, lowest=-8)
    drawn = lines(picture)
    assert list(drawn) == ["marked (40)", "wrong key (300)", "α itself"]
    for (x, y), values in zip(drawn.values(), kinds.values(), strict=False):
        assert (x[0], x[-1]) == (-8, 0)
        np.testing.assert_allclose(y, [np.mean(values <= at) for at in x])
    x, y = drawn["α itself"]
    np.testing.assert_allclose(np.log10(y), x)
    hits = np.array([np.sum(kinds["marked"] <= at) for at in x])
    check_shade(picture, 0, x, hits, 40)
    assert all("probability" in label or "share" in label for label in labels(picture))


def test_p_values_lie_below_a_bound_that_holds_and_above_one_that_does_not():
    rng = np.random.default_rng(1)
    scores = rng.normal(size=2000)
    sound = np.array([log10_p_score(score, 1.0) for score in scores])
    picture = pictures.p_values({"bound": sound, "twice its exponent": 2 * sound})
    drawn = lines(picture)
    x, bound = drawn["the bound, 10^x"]
    np.testing.assert_allclose(bound, 10**x)
    for values, (at, share) in zip((sound, 2 * sound), drawn.values(), strict=False):
        np.testing.assert_allclose(share, [np.mean(values <= one) for one in at])
    resolved = x < -0.5
    assert (drawn["bound (2000)"][1] <= bound)[resolved].all()
    assert (drawn["twice its exponent (2000)"][1] > bound)[(x > -3) & (x < -2.2)].all()
    hits = np.array([np.sum(sound <= at) for at in x])
    check_shade(picture, 0, x, hits, 2000)
    assert labels(picture) == ("x, a log10 p", "share of suspects with log10 p ≤ x")


def check_shade(picture: plot.Picture, place: int, x: np.ndarray, hits: np.ndarray, trials: int) -> None:
    """The interval of a band is the beta distribution's."""
    corners = picture.figure.axes[0].collections[place].get_paths()[0].vertices
    for at in (0, len(x) // 2, len(x) - 1):
        there = corners[np.isclose(corners[:, 0], x[at]), 1]
        k = hits[at]
        low = stats.beta.ppf(0.025, k, trials - k + 1) if k else 0
        high = stats.beta.ppf(0.975, k + 1, trials - k) if k < trials else 1
        np.testing.assert_allclose((there.min(), there.max()), (low, high), atol=1e-9)


def test_success_over_strength():
    read = np.array([[True] * 4, [True, True, False, True], [False] * 4])
    bits = np.array([11.0, 9.0, 7.0])
    curve = Robustness(bits, read, 0.5 - 0.5 * read, MIN_LOG10_P * read, MIN_LOG10_P * read, (("",) * 4,) * 3)
    picture = pictures.success({"one": curve, "two": curve._replace(success=~read)}, "bits per coordinate")
    axes = picture.figure.axes[0]
    drawn = [container.lines for container in axes.containers]
    for (line, _, (bars,)), hits in zip(drawn, ([4, 3, 0], [0, 1, 4]), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), bits)
        np.testing.assert_allclose(line.get_ydata(), np.array(hits) / 4)
        for segment, hit in zip(bars.get_segments(), hits, strict=True):
            expected = stats.binomtest(hit, 4).proportion_ci(0.95, method="exact")
            np.testing.assert_allclose(segment[:, 1], expected, atol=1e-9)
    assert drawn[0][0].get_color() != drawn[1][0].get_color()
    assert drawn[0][0].get_marker() != drawn[1][0].get_marker()
    assert axes.get_xlabel() == "strength: bits per coordinate"
    assert axes.get_xlim()[0] > axes.get_xlim()[1]  # weak ones, with many bits, on the left
    assert axes.get_xscale() == "linear"
    wide = pictures.success({"one": curve._replace(strengths=np.array([1e-3, 0.01, 0.1]))}, "")
    assert wide.figure.axes[0].get_xscale() == "log"
    assert wide.figure.axes[0].get_xlim()[0] < wide.figure.axes[0].get_xlim()[1]


def test_files_are_png_and_the_same_each_time(pair, tmp_path):
    original, moved = pair

    def made() -> list[plot.Picture]:
        return [
            plot.draw([plot.View("original", original.mesh), plot.displacement(original, moved)]),
            pictures.roc({"marked": np.linspace(-9, 0, 12)}),
            plot.responses({"damped": scaling(4, damping="jackson")}),
        ]

    for first, second in zip(made(), made(), strict=True):
        data = first.png()
        assert data.startswith(PNG)
        assert data == second.png() == first._repr_png_()
        first.save(tmp_path / "picture.png")
        assert (tmp_path / "picture.png").read_bytes() == data
    plot.save_views([plot.View("original", original.mesh)], tmp_path / "views.png")
    assert (tmp_path / "views.png").read_bytes() == plot.draw([plot.View("original", original.mesh)]).png()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["picture.png", "views.png"]
    with pytest.raises(jm.JaxmarkError, match="does not exist"):
        made()[0].save(tmp_path / "none" / "picture.png")


def test_the_viewer_holds_meshes_and_colours_and_needs_no_network(pair, tmp_path):
    original, moved = pair
    mesh, far = original.mesh, plot.exaggerate(original, moved)
    values = np.linspace(0, 2, len(mesh.vertices))
    viewer = plot.show(plot.View("<original>", mesh), far, plot.View("seen", mesh, values, "% <of> diagonal"))
    viewer.save(tmp_path / "mesh.html")
    page = (tmp_path / "mesh.html").read_text()
    assert not re.search(r"<script[^>]*\ssrc|<link|@import|<img", page)
    (data,) = re.findall(r'base64_data="([^"]+)"', page)
    with (tmp_path / "mesh.glb").open("wb") as file:
        file.write(base64.b64decode(data))
    found = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry
    assert list(found) == ["view0", "view1", "view2"]
    assert np.linalg.norm(found["view0"].extents) == pytest.approx(1, rel=1e-5)
    centre = np.mean(mesh.vertices, axis=0)
    for one, shown in zip(found.values(), (mesh, far.mesh, mesh), strict=True):
        np.testing.assert_allclose(one.vertices * original.diagonal + centre, shown.vertices, atol=1e-5)
        np.testing.assert_array_equal(one.faces, mesh.faces)
    expected = np.array([matplotlib.colormaps["cividis"](value / 2, bytes=True) for value in values])
    np.testing.assert_allclose(found["view2"].visual.vertex_colors.astype(int), expected.astype(int), atol=1)
    assert (found["view0"].visual.vertex_colors[:, :3] > 190).all()  # bright
    assert "2 % &lt;of&gt; diagonal" in " ".join(re.sub("<[^>]*>", " ", page).split())
    chosen = re.findall(r'<input type="radio" name="view" value="(\d)"( checked)?> ([^<]*)<', page)
    assert chosen == [("0", " checked", "&lt;original&gt;"), ("1", "", "10 × the displacement"), ("2", "", "seen")]
    assert "drag to turn" in page
    (frame,) = re.findall(r'srcdoc="([^"]*)"', viewer._repr_html_())
    assert html.unescape(frame) == viewer.page


def test_a_viewer_of_one_mesh_has_nothing_to_choose(pair):
    mesh = pair[0].mesh
    assert plot.show(mesh) == plot.show(mesh)
    assert "<input" not in plot.show(mesh).page
    assert "linear-gradient" not in plot.show(mesh).page
    assert "<strong>mine</strong>" in plot.show(plot.View("mine", mesh)).page
    with pytest.raises(jm.JaxmarkError, match="at least one mesh"):
        plot.show()


def test_refusals(pair, unchecked, monkeypatch):
    original, _ = pair
    with pytest.raises(jm.JaxmarkError, match="finite values, one for each vertex"):
        plot.show(plot.View("", original.mesh, np.zeros(3)))
    with pytest.raises(jm.JaxmarkError, match="one log10 p or more"):
        pictures.roc({"nothing": np.zeros(0)})
    with pytest.raises(jm.JaxmarkError, match="lowest is a negative number"):
        pictures.roc({"some": np.zeros(2)}, lowest=0.0)
    with pytest.raises(jm.JaxmarkError, match="does not share"):
        plot.displacement(original, bumpy_sphere(1))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for drawing in (lambda: pictures.roc({"some": np.zeros(2)}), lambda: plot.show(original.mesh)):
        with pytest.raises(jm.JaxmarkError, match=r"jaxmark\[plot\]"):
            drawing()
