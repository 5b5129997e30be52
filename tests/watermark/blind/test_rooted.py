"""Marks in lattices that begin at landmarks: what a reader finds on parts, and what the writer chooses."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark import RootedScheme
from jaxmark.watermark.blind import reading, roots
from jaxmark.watermark.blind.lattices import CutSurface, Frames, Lattices, find_roots
from jaxmark.watermark.blind.reading import read, register
from jaxmark.watermark.blind.roots import make_regions
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.markers import make_blind_marker
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, make_blind_scheme
from tests.samples import bumpy_sphere

MESSAGE = b"\xc0"
KEY = jm.Key(bytes(range(32)))
WIDTH, UNIT = 0.02, 2.0**1.5  # the narrow Gaussian is wider than usual, so that there is little to compute


def rough() -> Mesh:
    """A closed surface of 2,562 points with bumps, whose diagonal is 2.9."""
    mesh = bumpy_sphere(4)
    return mesh._replace(vertices=np.asarray(mesh.vertices) * [1, 0.75, 0.55])


@pytest.fixture(scope="module")
def scaled() -> Mesh:
    """The same in widths."""
    return rough()._replace(vertices=np.asarray(rough().vertices) / (WIDTH * UNIT))


@pytest.fixture(scope="module")
def surface(scaled: Mesh) -> CutSurface:
    return CutSurface(scaled)


@pytest.fixture(scope="module")
def frames(scaled: Mesh) -> Frames:
    return Frames.of(find_roots(scaled).clearest(6))


def in_common(*lattices: Lattices) -> list[Lattices]:
    """Those anchors that all have; others are at the limit of what counts."""
    rows = [
        {(int(frame), *cell.tolist()): row for row, (frame, cell) in enumerate(zip(*one[:2], strict=True))}
        for one in lattices
    ]
    names = set.intersection(*map(set, rows))
    assert len(names) > 0.95 * max(map(len, rows))
    return [one.pick(np.array([row[name] for name in sorted(names)])) for one, row in zip(lattices, rows, strict=True)]


def test_lattices_move_with_the_surface(scaled: Mesh, surface: CutSurface, frames: Frames):
    """Reversed faces are seen as if they were not."""
    turn = Rotation.random(random_state=1).as_matrix()
    pose = Pose(turn, np.array([3.0, -1, 2]))
    moved = Frames(pose(frames.places), turn @ frames.axes, frames.kinds)
    there = CutSurface(Mesh(pose(np.asarray(scaled.vertices)), np.asarray(scaled.faces)[:, ::-1]))
    here, seen = in_common(surface.lattices(frames, 10.0), there.lattices(moved, 10.0, inside_out=True))
    np.testing.assert_allclose(seen.places, pose(here.places), atol=1e-9)
    # The surface is cut into other pieces there.
    np.testing.assert_allclose(seen.values, here.values, atol=0.01)
    assert np.std(here.values) > 0.05


def test_slopes_are_derivatives_along_the_axes_of_frames(surface: CutSurface, frames: Frames):
    for change in 0.02 * np.eye(6):
        moved = (frames.moved(np.tile(way * change, (6, 1))) for way in (0, 1, -1))
        before, after, behind = in_common(*(surface.lattices(one, 10.0) for one in moved))
        difference = (after.values - behind.values) / 0.04
        np.testing.assert_allclose(before.slopes @ change / 0.02, difference, atol=0.02 * np.abs(difference).max())


def test_rough_values_differ_by_less_than_a_tenth_of_the_least_step(surface: CutSurface, frames: Frames):
    exact, approximate = in_common(*(surface.lattices(frames, 10.0, rough=is_rough) for is_rough in (False, True)))
    assert np.sqrt(np.mean((exact.values - approximate.values) ** 2)) < 0.1 * min(RootedScheme().steps)


def test_each_anchor_belongs_to_the_nearest_root_and_has_one_name(scaled: Mesh, surface: CutSurface, monkeypatch):
    monkeypatch.setattr(roots, "_stability", lambda _, landmarks: landmarks.clarity / landmarks.clarity.max())
    regions = make_regions(scaled, surface)
    found = find_roots(scaled)
    lattices, count = regions.lattices, len(regions.kinds)
    assert len(np.unique(regions.names, axis=0)) == len(regions.names)
    assert len({*zip(regions.kinds.tolist(), regions.classes.tolist(), strict=True)}) == count
    assert count == 1 or np.bincount(lattices.frame, minlength=count).min() >= 60
    # The roots are landmarks: each cell of zeros, if there is one, lies at a landmark of the kind.
    for index in range(count):
        at_root = lattices.places[(lattices.frame == index) & ~lattices.cells.any(axis=1)]
        of_kind = found.places[found.kinds == regions.kinds[index]]
        assert all(np.linalg.norm(of_kind - spot, axis=1).min() < 1e-9 for spot in at_root)
    # Anchors of different roots are apart.
    for index in range(count):
        own, others = lattices.places[lattices.frame == index], lattices.places[lattices.frame != index]
        if len(others):
            assert np.linalg.norm(own[:, None] - others, axis=2).min() > 2.5


def test_damaged_units_are_refused():
    usual = BLIND_SCHEMES["rooted"]
    parameters = {"width": usual.widths[0], "step": usual.steps[0]}
    assert make_blind_scheme("rooted", {**parameters, "unit": "2.0"}).looks == 4
    assert make_blind_scheme("rooted", {**parameters, "unit": repr(2.0**0.5)}).looks == 4
    for unit in ("0", "-1", "inf", "nan", "much", "1.5", "1.4142"):
        with pytest.raises(jm.JaxmarkError, match="unit is no power"):
            make_blind_scheme("rooted", {**parameters, "unit": unit})


def test_whoever_names_a_scheme_is_charged_for_the_others(monkeypatch):
    monkeypatch.setattr(RootedScheme, "views", lambda *_: iter(()))
    found = jm.detect(rough(), key=KEY, scheme="rooted", bits=8)
    (charge,) = [one for one in found.evidence.charges if one.choice == ledger.BLIND_SCHEME.name]
    assert charge.log10 == pytest.approx(np.log10(len(BLIND_SCHEMES)))


def test_a_unit_that_the_reader_chose_proves_nothing():
    """Otherwise one of many units could be charged as the only one."""
    chosen = replace(BLIND_SCHEMES["rooted"], unit="2.0")
    assert reading._caveats(chosen, None) == ("the unit was chosen by the reader; give the record",)
    assert not reading._caveats(BLIND_SCHEMES["rooted"], None)


def test_nothing_is_tuned_where_anchors_are_found_by_the_key():
    with pytest.raises(jm.JaxmarkError, match="found on marked meshes only"):
        jm.evaluation.tune_blind(rough(), [("noise", 0.001)], 2e-3, seed=0, bits=8, scheme="rooted")


class Work(NamedTuple):
    mesh: Mesh
    scheme: RootedScheme


@pytest.fixture(scope="module")
def marked() -> Work:
    marker = make_blind_marker(rough(), KEY, bits=8, scheme=RootedScheme(widths=(WIDTH,)))
    mesh, info = marker.embed(MESSAGE, 4e-3, read_back="never")
    parameters = info.record.parameters
    assert parameters["unit"] == repr(UNIT)
    return Work(mesh, replace(marker.scheme, steps=(parameters["step"],), unit=parameters["unit"]))


def find(suspect: Mesh, work: Work, key: bytes = KEY):
    return read(register(suspect), jm.Key(key), 8, work.scheme, MESSAGE)


@pytest.mark.slow
def test_a_part_is_read_after_remeshing_in_any_pose(marked: Work):
    part = jm.attack(jm.attack(marked.mesh, "cropping", 0.4, seed=0), "isotropic", 1.0, seed=0)
    turn = Rotation.random(random_state=2).as_matrix()
    vertices = np.asarray(part.vertices) @ turn.T + [5, 0, -3]
    assert find(part._replace(vertices=vertices), marked).log10_p < -6


@pytest.mark.slow
def test_mirror_images_of_parts_inside_out_are_read(marked: Work):
    part = jm.attack(marked.mesh, "cropping", 0.4, seed=0)
    found = find(part._replace(vertices=np.asarray(part.vertices) * [-1, 1, 1]), marked)
    assert found.log10_p < -6
    assert "The suspect is the mirror image of the marked mesh." in found.notes


@pytest.mark.slow
def test_nothing_is_found_by_other_keys_nor_in_the_original(marked: Work):
    unmarked, part = (jm.attack(mesh, "cropping", 0.6, seed=0) for mesh in (rough(), marked.mesh))
    assert find(unmarked, marked).log10_p > -3
    for seed in range(3):
        assert find(part, marked, np.random.default_rng(seed).bytes(32)).log10_p > -3
