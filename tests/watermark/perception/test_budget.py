"""How strong a mark is: RMS displacement, limits on metrics, or both."""

import json
import math
import sys

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.app import cli
from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.perception.budget import VISIBILITY, displace_within, largest_within, visibility_of
from tests.samples import rough_sphere, with_thin_faces

MESSAGE = b"\xa5\x5a"
SUBSET = ["gl", "dame", "fmpd", "msdm", "max", "mrms"]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return rough_sphere(2000)


@pytest.fixture(scope="module")
def noise(mesh: Mesh) -> np.ndarray:
    return np.random.default_rng(0).normal(size=mesh.vertices.shape)


@pytest.mark.parametrize("name", SUBSET)
def test_a_limit_is_reached_and_never_passed(name, mesh: Mesh, noise: np.ndarray):
    original = make_original(mesh)
    goal = 0.02 if name in ("dame", "fmpd", "msdm") else 3e-4
    written = displace_within(original, noise, jm.Budget(limits={name: goal}).bounds(mesh))
    assert 0.98 * goal <= jm.compare(mesh, written.mesh)._asdict()[name] <= goal


def test_the_tightest_of_several_bounds_counts(mesh: Mesh, noise: np.ndarray):
    original = make_original(mesh)
    for budget in (jm.Budget(rms=1e-4, limits={"dame": 1.0}), jm.Budget(rms=1e-4)):
        assert displace_within(original, noise, budget.bounds(mesh)).moved.rms == pytest.approx(1e-4)
    budget = jm.Budget(rms=0.5, limits={"dame": 0.01, "msdm": 0.9}).bounds(mesh)
    found = jm.compare(mesh, displace_within(original, noise, budget).mesh)
    assert 0.0098 <= (found.dame or 0) <= 0.01
    assert (found.msdm or 0) <= 0.9


def largest_stretch(original: Mesh, distorted: Mesh) -> float:
    """Largest relative change of an edge's length."""
    faces = np.asarray(original.faces)
    before, after = (
        np.linalg.norm(np.asarray(one.vertices)[faces] - np.asarray(one.vertices)[np.roll(faces, 1, axis=1)], axis=2)
        for one in (original, distorted)
    )
    return float(np.abs(after / before - 1).max())


def test_a_metric_of_ones_own_can_be_limited(mesh: Mesh, noise: np.ndarray, key: jm.Key):
    budget = jm.Budget(limits={largest_stretch: 0.02, "max": 0.1}).bounds(mesh)
    assert str(budget) == "largest_stretch of at most 0.02 and max of at most 0.1"
    found = largest_stretch(mesh, displace_within(make_original(mesh), noise, budget).mesh)
    assert 0.98 * 0.02 <= found <= 0.02
    marked, _ = jm.embed(mesh, MESSAGE, key, budget=jm.Budget(limits={largest_stretch: 0.02}, noise=0))
    assert 0.98 * 0.02 <= largest_stretch(mesh, marked) <= 0.02
    with pytest.raises(jm.JaxmarkError, match="The limit of largest_stretch must be a positive number"):
        jm.Budget(limits={largest_stretch: 0.0})


def test_a_limit_that_a_few_faces_make_tight_is_named_with_them(mesh: Mesh, noise: np.ndarray, unchecked):
    """A face is split at a point so near to a corner that the edge between them bounds the whole mark."""
    bounds = jm.Budget(limits={largest_stretch: 0.02}).bounds(mesh)
    assert displace_within(make_original(mesh), noise, bounds).note == ""
    noise = np.vstack([noise, -noise[mesh.faces[0, 0]]])
    written = displace_within(make_original(with_thin_faces(mesh)), noise, bounds)
    assert written.note.startswith("The limit of largest_stretch, 0.02, allows only ")
    named = written.note.split("others: ")[1]
    assert {int(part.split()[0]) for part in named.split(", ")} & {0, 2}
    info = EmbedInfo(0, 0, 0, None, notes=(written.note,))  # pyright: ignore[reportArgumentType]
    with pytest.raises(jm.JaxmarkError, match=r"^First\. The limit of largest_stretch"), info.explained():
        raise jm.JaxmarkError("First.")


def test_a_limit_that_no_displacement_keeps_is_named(mesh: Mesh, noise: np.ndarray):
    def counted(original: Mesh, distorted: Mesh) -> float:
        return float((original.vertices != distorted.vertices).any(axis=1).sum())

    with pytest.raises(jm.JaxmarkError, match=r"The limit of counted, 1, allows no displacement.* it is 2e\+03"):
        displace_within(make_original(mesh), noise, jm.Budget(limits={counted: 1, "dame": 1}).bounds(mesh))


@pytest.mark.slow
def test_without_a_word_the_mark_stays_below_what_people_notice(mesh: Mesh, key: jm.Key):
    marked, info = jm.embed(mesh, MESSAGE, key, budget=jm.Budget(noise=0))
    found = jm.compare(mesh, marked, ["shading", "dame", "stretch", "rms"])
    limits = visibility_of(mesh)["hidden"]
    assert limits.keys() == VISIBILITY["hidden"].keys()
    used = {name: getattr(found, name) / limit for name, limit in limits.items()}
    assert 0.98 <= max(used.values()) <= 1
    assert limits["shading"] < 1
    assert 0.008 <= limits["dame"] <= 0.02
    assert found.rms == pytest.approx(info.rms, rel=1e-6)
    assert found.msdm2 is None  # not asked for
    assert jm.detect(marked, original=mesh, key=key, bits=16).message == MESSAGE


@pytest.mark.parametrize(
    "rising",
    [
        lambda size: size / 3e-4,
        lambda size: (size / 3e-4) ** 3,
        lambda size: (size / 3e-4) ** 0.1,
        lambda size: size / 6e-4 if size < 3e-4 else 5.0,  # a jump over the limit
        lambda size: math.inf if size > 3e-4 else 0.0,
        lambda size: 1.5 * math.tanh(size / 3e-4 * math.atanh(2 / 3)),
        lambda size: size / 3e-4 if size < 0.0029 else math.nan,
    ],
)
def test_the_largest_size_is_found_for_any_rising_metric(rising):
    found = largest_within(rising, 0.01, 2e-4)
    assert rising(found) <= 1
    assert 0.88 * 3e-4 < found <= 3e-4


@pytest.mark.slow
def test_capacity_under_limits_is_that_of_the_displacement_they_allow(mesh: Mesh, key: jm.Key):
    noise = 0.005
    most = jm.capacity(mesh, jm.Budget(limits={"dame": 0.02}, noise=noise))
    assert 8 <= most < jm.capacity(mesh, jm.Budget(limits={"dame": 0.04}, noise=noise))
    _, info = jm.embed(mesh, bytes(most // 8), key, budget=jm.Budget(limits={"dame": 0.02}, noise=noise))
    assert jm.capacity(mesh, jm.Budget(rms=info.rms, noise=noise)) >= most
    with pytest.raises(jm.JaxmarkError, match=f"carries at most {most} bits at dame of at most 0.02,"):
        jm.embed(mesh, bytes(most // 8 + 3), key, budget=jm.Budget(limits={"dame": 0.02}, noise=noise))


@pytest.mark.slow
def test_limits_from_the_shell(mesh: Mesh, tmp_path, monkeypatch, capsys):
    def run(*arguments: str) -> dict:
        monkeypatch.setattr(sys, "argv", ["jaxmark", *arguments, "--json"])
        cli.main()
        return json.loads(capsys.readouterr().out)

    model, marked, key = (str(tmp_path / name) for name in ("model.ply", "marked.ply", "key"))
    jm.save_mesh(mesh, model)
    run("keygen", key)
    mark = ("embed", model, marked, "--key", key, "--message", "a55a", "--noise", "0")
    written = run(*mark, "--limit", "dame=0.004", "--limit", "gl=0.0001")
    found = run("compare", model, marked)
    assert found["dame"] <= 0.004 * 1.001  # rounded to the file's numbers
    assert found["gl"] <= 0.0001 * 1.001
    assert max(found["dame"] / 0.004, found["gl"] / 0.0001) > 0.98
    assert found["rms"] == pytest.approx(written["rms"], rel=1e-5)
    assert run("capacity", model, "--limit", "dame=0.05")["limits"] == {"dame": 0.05}
    for wrong, sentence in (("dame", "is not a limit"), ("dame=x", "is not a limit"), ("size=1", "no metric 'size'")):
        monkeypatch.setattr(sys, "argv", ["jaxmark", *mark, "--limit", wrong])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 2
        assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("budget", "limits", "sentence"),
    [
        (None, {}, "budget or at least one limit"),
        (None, {"dame": 0.0}, "must be a positive number"),
        (None, {"dame": math.nan}, "must be a positive number"),
        (1.5, None, "in \\(0, 1\\)"),
        (None, {"hausdorf": 1.0}, "no metric 'hausdorf'"),
    ],
)
def test_budgets_out_of_range_are_refused(budget, limits, sentence):
    with pytest.raises(jm.JaxmarkError, match=sentence):
        jm.Budget(rms=budget, limits=limits)


def test_limits_that_bind_nothing_are_refused_without_a_budget(mesh: Mesh, noise: np.ndarray):
    original = make_original(mesh)
    with pytest.raises(jm.JaxmarkError, match=r"give a budget .* such as --budget 0\.003, or Budget\(rms=0\.003\)"):
        displace_within(original, noise, jm.Budget(limits={"rms": 0.5}).bounds(mesh))
    # Three triangles without a common edge have no dihedral angle.
    loose = make_original(make_mesh(np.random.default_rng(0).normal(size=(9, 3)), np.arange(9).reshape(3, 3)))
    with pytest.raises(jm.JaxmarkError, match=r"give a budget .* such as --budget 0\.003, or Budget\(rms=0\.003\)"):
        displace_within(loose, np.ones((9, 3)) * [1, 2, 3], jm.Budget().bounds(loose.mesh))
