"""The benchmark of the field: its statistics against published values and simulation, and whole runs of small ones."""

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from scipy import stats

import jaxmark as jm
from jaxmark.app.bench_commands import ManyValues
from jaxmark.bench import Method, Reading, calibration, paired, tracks
from jaxmark.bench import composed_attacks as compositions
from jaxmark.bench import robustness_curves as quality
from jaxmark.bench.corpus import corpus, known_hashes, make_member
from jaxmark.bench.method import METHODS, digest_of, get_method, load_method
from jaxmark.bench.strength_search import SHARE, fit
from jaxmark.bench.tables import tables
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, diagonal
from tests import ROOT
from tests.samples import bumpy_sphere

KEY = bytes(range(32))


def signs(key: bytes, count: int) -> np.ndarray:
    return np.random.default_rng(list(key)).choice([-1.0, 1.0], count)


def embed_signs(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
    moved = strength * diagonal(mesh) * signs(key, len(mesh.vertices))[:, None]
    return Mesh(np.asarray(mesh.vertices) + moved * [0, 0, 1], mesh.faces)


def read_signs(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
    """The sum of so many tosses, at unit variance; its bound is Hoeffding's."""
    shift = np.sign(np.asarray(suspect.vertices)[:, 2] - np.asarray(original.vertices)[:, 2])
    score = float(shift @ signs(key, len(shift)) / max(np.linalg.norm(shift), 1e-300))
    return Reading(None, score, -(max(score, 0.0) ** 2) / 2 / math.log(10))


SIGNS = Method("signs", embed_signs, read_signs, blind=False, bits=0, strengths=(1e-6, 1e-2))


# -- statistics


def test_a_threshold_has_the_rate_that_order_statistics_say():
    random, rates, inside = np.random.default_rng(0), [], 0
    for _ in range(400):
        found = calibration.threshold(random.normal(size=299), 0.01)
        rate = stats.norm.sf(found.value)
        rates.append(rate)
        inside += found.low <= rate <= found.high
    assert found.rate == pytest.approx(0.01)
    assert found.reached
    assert np.mean(rates) == pytest.approx(0.01, rel=0.1)
    assert 0.92 <= inside / 400 <= 0.98
    assert not calibration.threshold(random.normal(size=50), 0.01).reached


def test_an_roc_has_the_area_of_the_rank_sum():
    random = np.random.default_rng(1)
    nulls, marks = random.integers(0, 6, 80).astype(float), random.integers(2, 9, 50).astype(float)
    area = calibration.area_under(calibration.roc(nulls, marks))
    assert area == pytest.approx(stats.mannwhitneyu(marks, nulls).statistic / 80 / 50)


def nulls_of_signs(count: int) -> list[tuple[float, float | None]]:
    """Scores of unmarked suspects, and the bound, as `read_signs` gives them."""
    scores = np.random.default_rng(2).normal(size=count)
    return [(score, -(max(score, 0.0) ** 2) / 2 / math.log(10)) for score in scores]


def test_a_bound_with_its_exponent_doubled_is_called_violated_and_the_right_one_is_not():
    nulls = nulls_of_signs(4000)
    right = calibration.calibrate(SIGNS, {"unmarked": nulls}, np.array([9.0]))
    assert right.verdicts == []
    assert right.bound[0].hits > 0
    doubled = [(score, 2 * p) for score, p in nulls]
    wrong = calibration.calibrate(SIGNS, {"unmarked": doubled}, np.array([9.0]))
    assert any("BOUND IS VIOLATED" in said for said in wrong.verdicts)


def test_a_reader_that_proves_only_what_is_unlikely_is_not_accused():
    """None counts as no proof: the same bound, stated where the score is high alone, holds as well."""
    nulls = [(score, p if score > 1.5 else None) for score, p in nulls_of_signs(4000)]
    found = calibration.calibrate(SIGNS, {"unmarked": nulls}, np.array([9.0]))
    assert found.verdicts == []
    assert found.bound[0].trials == 4000
    silent = [(score, None) for score, _ in nulls]
    assert calibration.calibrate(SIGNS, {"unmarked": silent}, np.array([9.0])).bound == []


@pytest.mark.parametrize(("value", "caught"), [(1.0, True), (6.0, False)])
def test_a_threshold_that_is_too_low_is_caught(value: float, caught: bool):
    method = replace(SIGNS, threshold=value, rate=1e-3)
    found = calibration.calibrate(method, {"unmarked": nulls_of_signs(300)}, np.array([9.0]))
    assert any("TOO LOW" in said for said in found.verdicts) == caught


def test_paired_intervals_are_newcombes():
    """Statistics in Medicine 17 (1998), 2635: table II, method 10, for 36, 12, 2 and 0 pairs."""

    def pairs(both: int, first: int, second: int, neither: int) -> paired.Paired:
        one = [True] * (both + first) + [False] * (second + neither)
        other = [True] * both + [False] * first + [True] * second + [False] * neither
        return paired.compare_paired(one, other)

    found = pairs(36, 12, 2, 0)
    assert (found.low, found.high) == pytest.approx((0.0569, 0.3404), abs=5e-5)
    assert found.p == pytest.approx(stats.binomtest(2, 14).pvalue)
    assert pairs(5, 0, 0, 5).p == 1
    with pytest.raises(jm.JaxmarkError, match="needs pairs"):
        paired.compare_paired([], [])


def points(threshold: float, seeds: int = 3) -> list[quality.Point]:
    """Marks that survive whatever costs less than a threshold."""
    low, high = quality.RANGES["mrms"]
    costs = np.geomspace(low, high, 60)
    return [
        quality.Point(mesh, seed, f"attack {place % 4}", {"mrms": cost}, bool(cost < threshold))
        for mesh in "ab"
        for seed in range(seeds)
        for place, cost in enumerate(costs)
    ]


def test_the_area_under_a_step_is_where_it_stands():
    low, high = quality.RANGES["mrms"]
    for share in (0.25, 0.6):
        found = quality.score(points(low * (high / low) ** share))
        assert found.value == pytest.approx(share, abs=0.02)
        assert found.low <= found.value <= found.high
    assert quality.score([]) is None
    refused = [one._replace(marked=False, success=False, costs={}) if one.mesh == "b" else one for one in points(1)]
    assert quality.score(refused).value == pytest.approx(0.5), "who refuses a mesh has lost it"
    alone = quality.score([one for one in points(1e-3) if (one.mesh, one.seed) == ("a", 0)])
    assert (alone.low, alone.high) == (0, 1)
    unknown = [quality.Point("a", 0, "crop", {"mrms": None}, True)]
    assert quality.score(unknown) is None


def test_an_interval_is_wider_where_meshes_differ():
    mixed = [one._replace(success=one.success or one.mesh == "a") for one in points(1e-3)]
    found = quality.score(mixed)
    assert found.high - found.low > 0.1
    assert found.value == pytest.approx((1 + quality.score(points(1e-3)).value) / 2, abs=0.03)


# -- parts


def test_every_method_by_name_declares_what_it_is():
    for name in METHODS:
        made = get_method(name, 32)
        assert made.name == name
        assert made.bits in (0, 32)
        assert 0 < made.strengths[0] < made.strengths[1]
        assert made.source
    with pytest.raises(jm.JaxmarkError, match="no method 'none'; there are keyed"):
        get_method("none", 32)


def test_a_mark_is_as_strong_as_limits_allow():
    mesh = bumpy_sphere(2)
    found = fit(SIGNS, mesh, np.zeros(0, bool), KEY, {"rms": 1e-3})
    assert SHARE * 1e-3 <= found.reached["rms"] <= 1e-3
    assert found.tries <= 8

    def careful(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
        if strength > 8e-4:
            raise jm.JaxmarkError("too strong")
        return embed_signs(mesh, message, key, strength)

    assert (
        0.9 * 8e-4 <= fit(replace(SIGNS, embed=careful), mesh, np.zeros(0, bool), KEY, {"rms": 1e-3}).strength <= 8e-4
    )
    with pytest.raises(jm.JaxmarkError, match="Even the weakest mark"):
        fit(replace(SIGNS, strengths=(5e-3, 1e-2)), mesh, np.zeros(0, bool), KEY, {"rms": 1e-3})


def test_the_weakest_mark_is_tried_before_a_method_is_refused():
    """The search ends above a strength that is too large: a cubic mark leaves it no step to take."""

    def cubic(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
        return embed_signs(mesh, message, key, strength**3)

    mesh = bumpy_sphere(2)
    found = fit(replace(SIGNS, embed=cubic, strengths=(0.093, 1.0)), mesh, np.zeros(0, bool), KEY, {"rms": 1e-3})
    assert 0.093 <= found.strength <= 0.1
    assert found.reached["rms"] <= 1e-3


def test_a_mark_is_neither_in_the_pose_nor_between_copies_of_a_vertex():
    mesh = bumpy_sphere(2)

    def moved(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
        return Mesh(np.asarray(mesh.vertices) * 3 + 7, mesh.faces)

    found = fit(replace(SIGNS, embed=moved), mesh, np.zeros(0, bool), KEY, {"rms": 1e-9})
    np.testing.assert_allclose(found.mesh.vertices, mesh.vertices, atol=1e-9)
    corners = np.asarray(mesh.faces).ravel()
    soup = Mesh(np.asarray(mesh.vertices)[corners], np.arange(len(corners)).reshape(-1, 3))
    with pytest.raises(jm.JaxmarkError, match="tears vertices apart"):
        fit(SIGNS, soup, np.zeros(0, bool), KEY, {"mrms": 1e-3})


def test_mirror_images_are_mirror_images():
    mesh = bumpy_sphere(2)
    mirrored = jm.attack(mesh, compositions.MIRROR, 0, seed=1)
    volume = [np.einsum("fi,fi->", v[f[:, 0]], np.cross(v[f[:, 1]], v[f[:, 2]])) for v, f in (mesh, mirrored)]
    assert volume[1] == pytest.approx(volume[0])  # turned inside out twice
    a, b = (np.asarray(one.vertices) - np.mean(one.vertices, axis=0) for one in (mesh, mirrored))
    u, _, v = np.linalg.svd(a.T @ b)
    assert np.linalg.det(u @ v) < 0
    np.testing.assert_allclose(a @ (u @ v), b, atol=1e-9)


def test_attackers_with_one_budget_spend_it():
    pytest.importorskip("igl")
    mesh = bumpy_sphere(3)
    for kind in ("noise", "smoothing"):
        found = jm.attack(mesh, compositions.to_budget(kind), 0.3, seed=0)
        assert 0.2 <= jm.compare(mesh, found, ["msdm2"]).msdm2 <= 0.3


def test_a_graft_keeps_what_is_left_and_adds_a_model():
    mesh = bumpy_sphere(3)
    found = jm.attack(mesh, compositions.GRAFT, 0.5, seed=0)
    kept = {tuple(row) for row in np.round(mesh.vertices, 9)} & {tuple(row) for row in np.round(found.vertices, 9)}
    assert len(kept) == pytest.approx(0.5 * len(mesh.vertices), abs=2)
    assert len(found.vertices) == pytest.approx(len(kept) + 500, abs=2)


def test_correlated_noise_has_its_variance_and_its_length():
    random = np.random.default_rng(0)
    at, values = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]), []
    for _ in range(1500):
        values.append(compositions._correlated(at, 2.0, random))
    covariance = np.cov(np.transpose(values))
    np.testing.assert_allclose(covariance[0], [1, np.exp(-1 / 8), np.exp(-81 / 8)], atol=0.1)


@pytest.mark.long
def test_every_attack_of_2026_leaves_a_mesh():
    """An attack that is not possible on this mesh would be refused."""
    for package in ("igl", "pymeshlab", "skimage", "fast_simplification", "DracoPy"):
        pytest.importorskip(package)
    mesh = bumpy_sphere(3)
    for name, line in tracks.LINES_2026.items():
        for suspect in line.suspects(mesh, 1) if not line.family and name != tracks.OVERWRITTEN else ():
            assert len(jm.make_mesh(suspect.vertices, suspect.faces).faces) > 50, name


def test_attacks_that_lack_a_package_are_named_and_left_out(monkeypatch):
    monkeypatch.setattr(tracks, "find_spec", lambda name: None)
    assert "pip install 'jaxmark[attacks]'" in tracks.LINES_2026["isotropic 1"].missing()
    assert tracks.LINES_2026["bending 10"].missing() == ""


def test_the_corpus_is_large_and_its_small_members_are_those_that_are_known():
    members, known = corpus(), known_hashes()
    assert len(members) >= 30
    assert {member.kind for member in members.values()} == {
        "scan",
        "CAD",
        "organic",
        "symmetric",
        "noisy",
        "components",
    }
    assert min(one.vertices for one in members.values()) <= 1000
    assert max(one.vertices for one in members.values()) >= 1_000_000
    for name, member in members.items():
        if member.vertices <= 3000:
            mesh = make_member(member)
            assert len(mesh.vertices) == pytest.approx(member.vertices, rel=0.15), name
            assert geometry_hash(mesh).hex() == known[name], name


# -- methods of one's own

PAGE = (ROOT / "docs" / "how-to" / "benchmark.md").read_text()
PYTHON = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[0]  # what a stranger begins with

PROGRAM = """
import json, sys
import numpy as np
import jaxmark as jm
from tests import ROOT
verb, key = sys.argv[1], np.random.default_rng(list(bytes.fromhex(sys.argv[2])))
original, other = jm.load_mesh(sys.argv[3]), sys.argv[4]
signs = key.choice([-1.0, 1.0], (8, len(original.vertices)))
if verb == "embed":
    bits = np.array([int(bit) for bit in sys.argv[5]])
    moved = float(sys.argv[6]) * (2.0 * bits - 1) @ signs
    jm.save_mesh(jm.Mesh(original.vertices + moved[:, None] * [0, 0, 1], original.faces), other)
else:
    soft = signs @ (jm.load_mesh(other).vertices - original.vertices)[:, 2]
    print(json.dumps({"message": "".join("01"[int(x > 0)] for x in soft), "score": float(abs(soft).sum())}))
"""

DECLARED = """
name = "program"
embed = "{python} program.py embed {{key}} {{original}} {{marked}} {{message}} {{strength}}"
read = "{python} program.py read {{key}} {{original}} {{suspect}}"
blind = false
bits = 8
strengths = [1e-6, 1e-1]
source = "a program"
"""


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    path = tmp_path / "plain.py"
    path.write_text(PYTHON)
    return path


def test_a_python_file_is_a_method(plain: Path):
    made = load_method(plain, 8)
    message, mesh = np.array([1, 0, 0, 1, 1, 1, 0, 1], bool), bumpy_sphere(2)
    assert (made.read(made.embed(mesh, message, KEY, 1e-4), KEY, mesh).message == message).all()
    assert len(PYTHON.splitlines()) <= 60
    plain.write_text("METHOD = 3\n")
    with pytest.raises(jm.JaxmarkError, match="has no method"):
        load_method(plain, 64)
    plain.write_text("raise KeyError('x')\n")
    with pytest.raises(jm.JaxmarkError, match="does not run: KeyError"):
        load_method(plain, 64)


@pytest.mark.slow
def test_a_toml_file_makes_programs_a_method(tmp_path: Path):
    (tmp_path / "program.py").write_text(PROGRAM)
    declared = tmp_path / "program.toml"
    declared.write_text(DECLARED.format(python=sys.executable))
    made = load_method(declared, 64)
    message, mesh = np.array([1, 0, 0, 1, 1, 1, 0, 1], bool), bumpy_sphere(2)
    assert (made.read(made.embed(mesh, message, KEY, 1e-3), KEY, mesh).message == message).all()
    with pytest.raises(jm.JaxmarkError, match=r"ended with status 1"):
        made.embed(mesh, message[:3], KEY, 1e-3)
    before = digest_of(declared)
    (tmp_path / "program.py").write_text(PROGRAM.replace("> 0", "< 0"))
    assert digest_of(declared) != before


def test_toml_files_that_declare_no_method_are_refused(tmp_path: Path):
    path = tmp_path / "bad.toml"
    for text, sentence in (
        ("name = 3 =", "is not a TOML file"),
        ('name = "x"', "declares no embed"),
        (DECLARED.format(python="python") + "speed = 1\n", "speed is no field"),
        (DECLARED.format(python="python").replace("[1e-6, 1e-1]", "[1e-6]"), "two numbers"),
        (
            DECLARED.format(python="python").replace("{suspect}", "{suspekt}"),
            "field {suspekt}; allowed here are suspect",
        ),
        (DECLARED.format(python="python").replace("false", "true"), "field {original}; allowed here are suspect, key"),
    ):
        path.write_text(text)
        with pytest.raises(jm.JaxmarkError, match=sentence):
            load_method(path, 64)


# -- whole runs


@pytest.fixture
def small(tmp_path: Path) -> dict:
    pytest.importorskip("igl")
    return {
        "meshes": {"ball": bumpy_sphere(2)},
        "output": tmp_path / "out",
        "attacks": ["none", "noise 0.001"],
        "keys": 60,
    }


@pytest.mark.slow
def test_a_run_of_ones_own_methods_is_calibrated_and_goes_on_where_it_was_ended(small: dict, plain: Path):
    said: list[str] = []
    methods = {"methods": [SIGNS, plain], "limits": ["perceptual"], "payloads": [8]}
    found = jm.bench.run(**small, **methods, log=said.append)
    assert len(said) == 2 + 2 * (2 * 60 + 1 + 2) + 2
    entries = jm.bench.entries(found)
    assert set(entries) == {"signs", "plain"}
    part = entries["plain"]["payloads"]["8"]
    attacks = part["tracks"]["smi2010"]["limits"]["perceptual"]["attacks"]
    assert attacks["none"]["read"] == attacks["none"]["trials"] == 1
    assert attacks["noise 0.001"]["published_bit_errors"] == {"cho": 0.03, "wang": 0.01}
    assert 0 < attacks["noise 0.001"]["costs"]["mrms"] < 0.002
    nulls = part["calibration"]["nulls"]
    assert {kind: one["trials"] for kind, one in nulls.items()} == {
        "unmarked": 60,
        "unmarked, attacked": 60,
        "unmarked, with the mark's key": 1,
        "another key's mark": 2,
        "another method's mark": 1,
    }
    assert entries["signs"]["payloads"]["8"]["calibration"]["verdicts"] == []
    assert entries["signs"]["payloads"]["8"]["calibration"]["bound"][0]["trials"] == 124
    assert entries["signs"]["validated"] == "not validated"
    assert found.projected(8, 5) == pytest.approx(40 * found.seconds)
    again = jm.bench.run(**small, **methods, log=lambda line: pytest.fail(line))
    assert jm.bench.entries(again) == entries
    assert found.paired("signs", "plain", "smi2010").both >= 1
    assert found.paired("signs", "plain", "smi2010", attacks=["none"]) != found.paired("signs", "plain", "smi2010")
    with pytest.raises(jm.JaxmarkError, match="no method 'plane'"):
        found.paired("signs", "plane", "smi2010")


@pytest.mark.slow
def test_a_mark_is_written_over_by_a_second_one_of_the_same_method(small: dict):
    """Of two marks of signs about as strong, each has half of the energy: 1/√2 of the score of one alone."""

    def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        shift = np.asarray(suspect.vertices)[:, 2] - np.asarray(original.vertices)[:, 2]
        return Reading(None, float(shift @ signs(key, len(shift)) / max(np.linalg.norm(shift), 1e-300)))

    method = replace(SIGNS, read=read)
    found = jm.bench.run(**{**small, "attacks": ["none", "overwritten"]}, tracks=["2026"], methods=[method])
    frame = found.frame()
    assert len(frame) == len(found.suspects)
    assert frame.detected.tolist() == [found.succeeds(one) for one in found.suspects]
    assert set(frame.attack) == {one.task.attack for one in found.suspects}
    scores = {one.task.attack: one.score / math.sqrt(len(small["meshes"]["ball"].vertices)) for one in found.suspects}
    assert scores["none"] == pytest.approx(1, abs=0.01), "the pose that the mark changed a little was undone"
    assert scores["overwritten"] == pytest.approx(math.sqrt(0.5), abs=0.12)
    assert found.calibrations["signs", 64].kinds["unmarked, attacked"].trials == small["keys"]


@pytest.mark.slow
def test_other_meshes_are_read_in_place_of_each_mesh(small: dict, tmp_path: Path):
    other, readings = tmp_path / "other.ply", []
    jm.save_mesh(bumpy_sphere(3), other)

    def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        readings.append((len(suspect.vertices), len(original.vertices), key))
        return Reading(None, 0.0)

    method = replace(SIGNS, read=read)
    found = jm.bench.run(**{**small, "keys": 3}, methods=[method], limits=["perceptual"], others=[other])
    sizes = len(bumpy_sphere(3).vertices), len(small["meshes"]["ball"].vertices)
    of_other = [key for *size, key in readings if tuple(size) == sizes]
    assert len(set(of_other)) == 3, "each with a key of its own"
    assert jm.bench.entries(found)["signs"]["payloads"]["64"]["calibration"]["nulls"]["another mesh"]["trials"] == 3


@pytest.mark.slow
def test_unmarked_suspects_are_made_once_for_all_methods(small: dict):
    made = []

    def counted(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        made.append(suspect.vertices.tobytes())
        return Reading(None, 0.0)

    first, second = replace(SIGNS, read=counted), replace(SIGNS, name="second", read=counted)
    jm.bench.run(**{**small, "attacks": ["noise 0.001"], "keys": 1}, methods=[first, second], limits=["perceptual"])
    # Each reads the unmarked one, attacked and not, its own with two keys, and the other's, which is not attacked.
    assert len(made) == 2 * (1 + 1 + 2 + 1)
    assert len(set(made)) == 1 + 1 + 2 + 2


def test_a_run_is_held_against_a_published_one(small: dict, plain: Path, tmp_path: Path):
    found = jm.bench.run(
        **{**small, "attacks": ["none"], "keys": 1}, methods=[plain], limits=["perceptual"], payloads=[8]
    )
    published = tmp_path / "readings.csv"
    jm.bench.save_readings(found, published)
    assert jm.bench.hold_against(found, jm.bench.load_published(published)) == (1, ())
    head, line = published.read_text().splitlines()
    fields = line.split(",")
    fields[head.split(",").index("read")] = "0"
    published.write_text(f"{head}\n{','.join(fields)}\n")
    shared, (difference,) = jm.bench.hold_against(found, jm.bench.load_published(published))
    assert shared == 1
    assert "read 1, published 0" in difference
    fields[head.split(",").index("bit_errors")] = "nan"
    for wrong in (f"{head}\n{line}\n{line}\n", f"{head}\n{','.join(fields)}\n", "x\n1\n", "", f"{head}\n", "\0\n"):
        published.write_text(wrong)
        with pytest.raises(jm.JaxmarkError, match=r"holds no readings of a benchmark.{,99}$"):
            jm.bench.load_published(published)


def test_a_reader_that_remembers_what_was_written_is_caught(small: dict):
    """It says that its mark is there whenever it is shown the key, which it is on the unmarked mesh, too."""
    known: set[bytes] = set()

    def remember(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
        known.add(key)
        return embed_signs(mesh, message, key, 1e-9)

    def recall(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        return Reading(None, float(key in known))

    method = replace(SIGNS, embed=remember, read=recall, threshold=0.5)
    run = {**small, "attacks": ["none"], "keys": 1}
    (found,) = jm.bench.run(**run, methods=[method], limits=["perceptual"]).calibrations.values()
    assert found.kinds["unmarked, with the mark's key"].trials == 1
    assert any("ITS OWN THRESHOLD IS TOO LOW" in said for said in found.verdicts)


@pytest.mark.slow
def test_more_keys_and_other_files_are_measured_anew(small: dict, tmp_path: Path):
    def nulls(keys: int) -> int:
        run = {**small, "meshes": [path], "attacks": ["none"], "keys": keys}
        found = jm.bench.run(**run, methods=[method], limits=["perceptual"])
        return found.calibrations["signs", 64].kinds["unmarked"].trials

    def read(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        sizes.add((len(suspect.vertices), len(original.vertices)))
        return Reading(None, 0.0)

    path, sizes, method = tmp_path / "mesh.ply", set(), replace(SIGNS, read=read)
    for subdivisions in (2, 1):
        jm.save_mesh(bumpy_sphere(subdivisions), path)
        assert [nulls(1), nulls(3), nulls(1)] == [1, 3, 1]
    assert sizes == {(162, 162), (42, 42)}


def test_names_that_no_league_has_are_refused(small: dict):
    for wrong, sentence in (
        ({"attacks": ["frost"]}, "no attack 'frost'; there are none, file"),
        ({"limits": ["hidden"]}, "no set of limits 'hidden'; there are perceptual, geometric"),
        ({"tracks": ["1999"]}, "no track '1999'; there are smi2010, 2026"),
        ({"methods": ["nothing"]}, "no method 'nothing'"),
        ({"meshes": ["nowhere.ply"]}, "nowhere.ply"),
        ({"rate": 2.0}, "between 0 and 1"),
        ({"workers": 0}, "needs at least one worker"),
    ):
        with pytest.raises(jm.JaxmarkError, match=sentence):
            jm.bench.run(**{**small, **wrong})


def test_methods_are_brought_to_the_same_visibility(small: dict, plain: Path):
    table = jm.bench.equal_visibility(
        small["meshes"], small["output"], methods=[SIGNS, plain], payloads=[8], shares=[1, 4]
    )
    assert [line[0] for line in table.lines] == ["signs", table.lines[1][0]]
    noises = [[float(cell.split()[0]) for cell in line[2:]] for line in table.lines]
    assert all(weak <= strong for weak, strong in noises)
    assert noises[0][1] > 0


def test_options_of_many_values_take_them_up_to_the_next_option():
    command = ManyValues("x", params=[click.Option(["--many"], multiple=True), click.Argument(["rest"], nargs=-1)])
    found = command.make_context("x", ["a", "--many", "b", "c d", "--many", "e", "--", "f"]).params
    assert found == {"rest": ("a", "f"), "many": ("b", "c d", "e")}
    for wrong in (["a", "--many"], ["a", "--many", "--many", "b"]):
        with pytest.raises(click.UsageError, match="'--many' needs a value"):
            command.make_context("x", wrong)


def test_methods_change_no_mesh_in_place(small: dict):
    """Else a mark would be measured against itself."""

    def careless(mesh: Mesh, message: np.ndarray, key: bytes, strength: float) -> Mesh:
        mesh.vertices[:] += strength
        return mesh

    method = replace(SIGNS, embed=careless)
    found = jm.bench.run(**{**small, "attacks": ["none"], "keys": 1}, methods=[method], limits=["perceptual"])
    assert "read-only" in found.tasks[0][1]["note"]


def test_a_method_that_fails_ends_nothing_but_its_cells(small: dict):
    def broken(suspect: Mesh, key: bytes, original: Mesh | None) -> Reading:
        raise ZeroDivisionError("oh")

    run = {**small, "attacks": ["none"], "keys": 1}
    found = jm.bench.run(**run, methods=[replace(SIGNS, read=broken)], limits=["perceptual"])
    assert any("ZeroDivisionError: oh" in line for table in tables(found) for line in table.lines)
    one = jm.bench.entries(found)["signs"]["payloads"]["64"]["tracks"]["smi2010"]["limits"]["perceptual"]["attacks"][
        "none"
    ]
    assert one["notes"] == ["ZeroDivisionError: oh"]
    assert one["detected"] == 0


def test_numbers_that_json_has_not_end_nothing_but_their_readings(small: dict, tmp_path: Path):
    """A probability of 0, and a score or a probability that is no number."""
    said = iter([(math.inf, -math.inf), (math.nan, None), (1.0, "n/a"), *[(0.0, math.nan)] * 9])
    method = replace(SIGNS, read=lambda suspect, key, original: Reading(None, *next(said)))
    run = {**small, "attacks": ["none"], "keys": 2}
    found = jm.bench.run(**run, methods=[method], limits=["perceptual"])
    readings = [one for _, row in found.tasks for one in row.get("readings", [])]
    assert readings[0]["score"] == sys.float_info.max
    assert readings[0]["log10_p"] < -1e300
    assert all("not a number" in one["note"] or "could not convert" in one["note"] for one in readings[1:])
    jm.bench.save_entries(found, tmp_path / "results.json")


@pytest.mark.slow
def test_the_command_writes_an_entry_for_each_method_and_a_page(tmp_path: Path, plain: Path):
    for extra in ("igl", "matplotlib", "jinja2"):
        pytest.importorskip(extra)
    mesh, output = tmp_path / "ball.ply", tmp_path / "out"
    jm.save_mesh(bumpy_sphere(3), mesh)
    command = [sys.executable, "-m", "jaxmark", "bench", str(mesh), "--methods", "keyed", "harmonics", "--method"]
    command += [str(plain), "--attacks", "none", "noise 0.003", "--limits", "perceptual", "--workers", "1"]
    command += ["--keys", "1"]
    done = subprocess.run([*command, "--output", str(output)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads((output / "results.json").read_text())
    assert set(found) == {"keyed", "harmonics", "plain"}
    attacks = found["keyed"]["payloads"]["64"]["tracks"]["smi2010"]["limits"]["perceptual"]["attacks"]
    assert attacks["none"]["read"] == 1
    page = (output / "page.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "plain†" in page
    text = (output / "results.md").read_text()
    assert "| attack |" in text
    assert re.search(r"\| noise 0.003 \| 1/1 0.00 -\d", text)
    assert "## smi2010, perceptual limits: distortion by the attacks" in text
    refused = subprocess.run(
        [*command[:5], "--methods", "nothing", "--output", str(output)], capture_output=True, text=True
    )
    assert refused.returncode == 2
    assert "There is no method 'nothing'" in refused.stderr
