"""Landmarks, and the hints of records that are made of them."""

import base64
from dataclasses import asdict, replace
from itertools import islice

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.blind import reading
from jaxmark.watermark.blind.anchors import place
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.blind.hint import Hint, Posed
from jaxmark.watermark.blind.landmarks import Border, Landmarks, find_landmarks
from jaxmark.watermark.blind.scheme import Look
from jaxmark.watermark.blind.search import moved, reliability
from jaxmark.watermark.schemes.registry import make_blind_scheme
from tests.samples import bumpy_sphere

WIDTHS = (0.05, 0.063)


@pytest.fixture(scope="module")
def bumpy() -> Mesh:
    """A smooth closed surface of 2,562 points, with bumps, in its own pose."""
    ball, random = trimesh.creation.icosphere(4), np.random.default_rng(0)
    waves = random.normal(size=(3, 8))
    waves *= 6 / np.linalg.norm(waves, axis=0)
    height = np.sin(ball.vertices @ waves + random.uniform(0, 6, 8)).sum(axis=1)
    points = ball.vertices * (1 + 0.04 * height)[:, None] * [1, 0.75, 0.55]
    return place(Mesh(points, np.asarray(ball.faces, np.int64))).mesh


@pytest.fixture(scope="module")
def landmarks(bumpy: Mesh) -> Landmarks:
    return find_landmarks(bumpy, WIDTHS).clearest(15)


@pytest.fixture(scope="module")
def rough() -> Mesh:
    """A closed surface of 2,562 points, rough enough for the narrow widths of hints, in its own pose."""
    mesh = bumpy_sphere(4)
    return place(mesh._replace(vertices=np.asarray(mesh.vertices) * [1, 0.75, 0.55])).mesh


@pytest.fixture(scope="module")
def hint(rough: Mesh) -> Hint:
    return Hint.of(rough, 1.0)


def share_found(landmarks: Landmarks, others: Landmarks, reach: float) -> float:
    """The share of landmarks beside which another of their kind lies."""
    kinds = np.unique(landmarks.kinds)
    trees = {kind: KDTree(others.places[others.kinds == kind]) for kind in kinds}
    near = [trees[kind].query(spot)[0] < reach for kind, spot in zip(landmarks.kinds, landmarks.places, strict=True)]
    return float(np.mean(near))


def test_landmarks_move_with_the_surface(bumpy: Mesh, landmarks: Landmarks):
    pose = Pose(3.7 * Rotation.random(random_state=3).as_matrix(), np.array([9.0, -5, 2]))
    moved = bumpy._replace(vertices=pose(np.asarray(bumpy.vertices)))
    there = find_landmarks(moved, [pose.scale * width for width in WIDTHS])
    assert share_found(landmarks.seen(pose), there, 0.3 * pose.scale * WIDTHS[0]) > 0.8


def test_landmarks_are_found_again_after_remeshing(bumpy: Mesh, landmarks: Landmarks):
    coarser = jm.attack(bumpy, "simplification", 0.5, seed=0)
    assert share_found(landmarks, find_landmarks(coarser, WIDTHS), 0.3 * WIDTHS[0]) > 0.8


def test_reversed_faces_exchange_minima_and_maxima(bumpy: Mesh, landmarks: Landmarks):
    inside_out = find_landmarks(bumpy._replace(faces=np.asarray(bumpy.faces)[:, ::-1]), WIDTHS).clearest(15)
    same = inside_out.seen(Pose(np.eye(3), np.zeros(3)), inside_out=True)
    assert share_found(landmarks, same, 1e-3) == 1
    np.testing.assert_allclose(np.sort(same.normals, axis=0), np.sort(landmarks.normals, axis=0), atol=1e-3)


def test_values_at_landmarks_are_extreme(bumpy: Mesh, landmarks: Landmarks):
    """By two Gaussian averages of many samples of the surface, computed here from their definition."""
    a, b, c = (np.asarray(bumpy.vertices)[np.asarray(bumpy.faces)[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    places, width = (a + b + c) / 3, WIDTHS[0]

    def value(spot: np.ndarray, normal: np.ndarray) -> float:
        offset = places - spot
        averages = []
        for size in (width, 2 * width):
            weight = area * np.exp(-np.sum(offset**2, axis=1) / 2 / size**2)
            averages.append(weight @ offset / weight.sum())
        return float((averages[0] - averages[1]) @ normal)

    clear = np.flatnonzero(landmarks.kinds < 2)
    clear = clear[np.argsort(-landmarks.clarity[clear])[:8]]
    for index in clear:
        spot, normal, tangent = (column[index] for column in landmarks[:3])
        sign = 1 if landmarks.kinds[index] & 1 else -1
        aside = [spot + way * width * tangent for way in (-0.8, 0.8)]
        assert sign * value(spot, normal) > max(sign * value(other, normal) for other in aside)


def test_borders_are_spared(bumpy: Mesh):
    part = jm.attack(bumpy, "cropping", 0.5, seed=0)
    found = find_landmarks(part, WIDTHS)
    assert Border(part).spares(found.places, 0.99 * WIDTHS[0]).all()
    assert not Border(part).spares(found.places, 1.0).any()
    assert Border(bumpy).spares(np.asarray(bumpy.vertices), 1.0).all()


def test_hints_are_stored(hint: Hint):
    text = hint.to_text()
    again = Hint.from_text(text)
    assert len(text) < 1800
    assert 10 < len(again.landmarks.places) <= 100
    np.testing.assert_allclose(again.landmarks.places, hint.landmarks.places, atol=2**-12)
    np.testing.assert_allclose(again.landmarks.frames, hint.landmarks.frames, atol=0.03)
    np.testing.assert_array_equal(again.landmarks.kinds, hint.landmarks.kinds)
    assert again.scale == 1
    assert again.to_text()[:12] == text[:12]


def edited(text: str, place: int, byte: int) -> str:
    """A hint with another byte in one place."""
    data = bytearray(base64.b64decode(text))
    data[place] = byte
    return base64.b64encode(data).decode()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text[:-4], "incomplete"),
        (lambda text: "", "incomplete"),
        (lambda text: text[:20], "incomplete"),
        (lambda text: "é" + text[1:], "incomplete"),
        (lambda text: edited(text, 0, 9), "version 9"),
        (lambda text: edited(text, 8, 255), "out of range"),  # a scale that is negative
        (lambda text: edited(text, 21, 6), "out of range"),  # an unknown kind
        (lambda text: edited(text, 10, 127), "out of range"),  # far away
        (lambda text: text + text[12:] * 100, "incomplete|out of range"),
    ],
)
def test_damaged_hints_are_refused(hint: Hint, change, reason: str):
    with pytest.raises(jm.JaxmarkError, match=reason):
        Hint.from_text(change(hint.to_text()))


@pytest.mark.parametrize(
    ("scale", "mirrored", "inside_out"),
    [(1.0, False, True), (25.4, True, True), pytest.param(2.9, True, False, marks=pytest.mark.slow)],
)
def test_the_pose_of_a_part_is_found(rough: Mesh, hint: Hint, scale: float, mirrored: bool, inside_out: bool):
    part = jm.attack(rough, "cropping", 0.3, seed=0)
    matrix = scale * Rotation.random(random_state=4).as_matrix() @ np.diag([-1.0 if mirrored else 1.0, 1, 1])
    moved = Pose(matrix, np.array([1.0, 2, 3]))
    faces = np.asarray(part.faces)
    suspect = Mesh(moved(np.asarray(part.vertices)), faces[:, ::-1] if inside_out else faces)
    *_, group = islice(Hint.from_text(hint.to_text()).poses(suspect), 2 if scale == 2.9 else 1)
    best = group[0]
    np.testing.assert_allclose(best.apply(suspect).vertices, np.asarray(part.vertices), atol=0.004)
    np.testing.assert_array_equal(best.apply(suspect).faces, part.faces)
    assert best.pose.mirrors == mirrored


@pytest.mark.slow
def test_a_suspect_of_any_size_costs_as_much(bumpy: Mesh, hint: Hint):
    """A suspect that is no part in the unit of the original is looked at in its own unit alone."""
    for factor in (1e-6, 1e6):
        other = bumpy._replace(vertices=factor * np.asarray(bumpy.vertices))
        assert len(list(hint.poses(other))) == 1


@pytest.mark.slow
def test_hints_of_one_kind_or_place_do_no_harm(rough: Mesh, hint: Hint):
    """Made by an owner who edits a record: a suspect shrinks to no point, and shares no kind with the hint."""
    one = hint.landmarks.pick(np.zeros(50, int))
    for kind, normal in ((5, one.normals), (0, np.roll(one.normals, 1, axis=1))):
        forged = replace(hint, landmarks=one._replace(kinds=np.full(50, kind), normals=normal))
        assert next(forged.poses(rough)) == []
    alien = find_landmarks(rough, [0.1]).pick(np.zeros(0, int))
    assert replace(hint, landmarks=one)._match(alien) == []


def test_landmarks_are_found_far_away_and_beside_a_crowd(bumpy: Mesh, landmarks: Landmarks):
    far = bumpy._replace(vertices=np.asarray(bumpy.vertices) + 1e6)
    assert share_found(landmarks._replace(places=landmarks.places + 1e6), find_landmarks(far, WIDTHS), 1e-3) == 1
    random = np.random.default_rng(0)
    crowd = [3.0, 0, 0] + 0.3 * random.normal(size=(20_000, 1, 3)) + 0.02 * random.normal(size=(20_000, 3, 3))
    count = len(bumpy.vertices)
    both = Mesh(
        np.concatenate([np.asarray(bumpy.vertices), crowd.reshape(-1, 3)]),
        np.concatenate([np.asarray(bumpy.faces), count + np.arange(60_000).reshape(-1, 3)]),
    )
    assert share_found(landmarks, find_landmarks(both, WIDTHS), 0.3 * WIDTHS[0]) > 0.8


@pytest.mark.filterwarnings("error")
def test_a_double_sided_surface_has_no_pose_of_its_own(bumpy: Mesh):
    """Without a warning by NumPy, too; the volume of the box is exactly 0."""
    box = trimesh.creation.box()
    for mesh in (bumpy, Mesh(np.asarray(box.vertices, np.float64), np.asarray(box.faces, np.int64))):
        faces = np.asarray(mesh.faces)
        double = mesh._replace(faces=np.concatenate([faces, faces[:, ::-1]]))
        with pytest.raises(jm.JaxmarkError, match="encloses no volume"):
            place(double)


def test_an_empty_hint_has_no_poses(bumpy: Mesh, hint: Hint):
    empty = replace(hint, landmarks=hint.landmarks.pick(np.zeros(0, int)))
    assert list(Hint.from_text(empty.to_text()).poses(bumpy)) == []


def test_records_with_other_parameters_are_refused(hint: Hint):
    known = {"width": 0.018, "step": 4e-4}
    text = hint.to_text()
    assert asdict(make_blind_scheme("field", known | {"hint": text}))["hint"] == text
    with pytest.raises(jm.JaxmarkError, match="incomplete"):
        make_blind_scheme("field", known | {"hint": text[:-4]})
    for name, parameters in (("field", {"hint": 3}), ("field", {"tip": "text"}), ("local", {"hint": "text"})):
        usual = known if name == "field" else {"width": 32.0, "step": 0.5}
        with pytest.raises(jm.JaxmarkError, match="other parameters"):
            make_blind_scheme(name, usual | parameters)


@pytest.fixture(scope="module")
def views(rough: Mesh, hint: Hint) -> tuple[Look, Look]:
    """Half of the surface, and all of it, in one pose, which is not quite the surface's own."""
    pose = Posed(Pose(Rotation.from_rotvec([0.01, 0.02, 0]).as_matrix(), np.array([0.003, 0, 0])), False, 0)
    scheme = FieldScheme(widths=(0.03,), hint=hint.to_text())
    half, whole = (scheme._in_pose(mesh, pose, (0.0,)) for mesh in (jm.attack(rough, "cropping", 0.5, seed=0), rough))
    return half[0], whole[0]


def values_at(view: Look, values: np.ndarray) -> dict[tuple[int, ...], float]:
    """The values of the anchors that count, by their cells."""
    cells = map(tuple, view.names[0][view.good].tolist())
    return dict(zip(cells, np.asarray(values, np.float64)[view.good].tolist(), strict=True))


def test_values_beside_a_border_are_off_by_the_expected_error(views: tuple[Look, Look]):
    half, whole = views
    assert not np.any(whole.error)
    errors, known = values_at(half, np.asarray(half.error)), values_at(whole, np.asarray(whole.values))
    off = [(errors[cell], abs(value - known[cell])) for cell, value in values_at(half, half.values).items()]
    error, difference = np.array(off).T
    far, near = error < 1e-3 * half.width, error > 0.01 * half.width
    assert min(far.sum(), near.sum()) > 10
    assert np.quantile(difference[far], 0.9) < 2e-3 * half.width
    assert 0.2 < np.sqrt(np.mean((difference[near] / error[near]) ** 2)) < 2


def test_derivatives_predict_what_is_seen_again(views: tuple[Look, Look]):
    half, _ = views
    change = 0.5 * np.array(half.spread) * [1, -1, 1, -1, 1, -1, 1]
    again = half.again(change)
    assert again is not None
    before, predicted = values_at(half, half.values), values_at(half, moved(half, change))
    seen = values_at(again, again.values)
    pairs = np.array([(seen[cell] - before[cell], predicted[cell] - before[cell]) for cell in before if cell in seen])
    assert len(pairs) > 50
    # A surface that was cut into other pieces, and what is not linear, change the values a little, too.
    assert np.corrcoef(pairs.T)[0, 1] > 0.97
    assert 0.9 < np.linalg.norm(pairs[:, 0]) / np.linalg.norm(pairs[:, 1]) < 1.1


def test_the_reliability_of_a_phase_is_its_mean_cosine():
    error, step = 0.02, 0.11
    turns = np.random.default_rng(0).normal(0, error, 200_000) / step
    for order in (1, 2):
        assert reliability(error, step / order) == pytest.approx(np.cos(2 * np.pi * order * turns).mean(), abs=0.01)


def test_anchors_that_are_not_reliable_do_not_count(views: tuple[Look, Look]):
    half, _ = views
    scheme, choices = FieldScheme(steps=(1e-3,)), reading.context(bytes(32), 8, "field")
    reliable = half.good & (np.arange(len(half.good)) % 2 == 0)
    weighted = half._replace(error=np.where(reliable, 0.0, np.inf), starts=64)
    dropped = half._replace(error=0.0, good=reliable, starts=64)
    for one, other in zip(*(reading._readings(view, scheme, choices, 64) for view in (weighted, dropped)), strict=True):
        np.testing.assert_allclose(one.soft, other.soft, atol=1e-6)
        assert (one.square, one.reliable) == pytest.approx((other.square, other.reliable))
        assert one.pilot == pytest.approx(other.pilot, abs=1e-4)


def test_reliabilities_whose_squares_underflow_have_their_norm(views: tuple[Look, Look]):
    """Otherwise the sum would have terms that its norm has not, and a suspect could be made so."""
    half, _ = views
    step, exponents = 1e-3, np.random.default_rng(0).uniform(0, 3, len(half.good))
    scheme, choices = FieldScheme(steps=(step,)), reading.context(bytes(32), 8, "field")
    scores = []
    for least in (0.0, 371.5):  # reliabilities of exp(-least - exponent), the latter about 1e-162
        error = step / np.pi * np.sqrt((least + exponents) / 2)
        unmoved = reading._readings(half._replace(error=error, starts=64), scheme, choices, 64)[0]
        scores.append(unmoved.soft / np.sqrt(unmoved.square))
    np.testing.assert_allclose(scores[1], scores[0], rtol=1e-6, atol=1e-12)
