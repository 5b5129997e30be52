"""Studies: against readings one by one, interrupted, refused, and declared in files; intervals as published."""

import base64
import csv
import hashlib
import html
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.attacks import Attack
from jaxmark.attacks.attack import mean_distance
from jaxmark.confidence import clopper_pearson
from jaxmark.evaluation._rates import Row
from jaxmark.evaluation.cells import load_finished
from jaxmark.evaluation.study import load_study
from jaxmark.evaluation.study_results import Results
from jaxmark.geometry.mesh import Mesh, diagonal
from tests.app.test_cli import Workshop
from tests.samples import bumpy_sphere

BUDGET = 2e-3


def stretched(mesh: Mesh, strength: float, key: object) -> Mesh:
    return Mesh(np.asarray(mesh.vertices) * [1, 1, 1 + strength], mesh.faces)


def scattered(mesh: Mesh, strength: float, key: object) -> Mesh:
    return Mesh(np.random.default_rng(0).normal(size=(3, 3)), np.arange(3)[None])


def picky(mesh: Mesh, strength: float, key: object) -> Mesh:
    """Refuses the one mesh that is not moved."""
    if np.array_equal(mesh.vertices, bumpy_sphere(3).vertices):
        raise jm.JaxmarkError("Not this one.")
    return mesh


def study(**changes) -> jm.Study:
    """A small one."""
    attacks = {"noise": [0.002, 0.2], "stretch": Attack(stretched, "share of the height", (0.1,), host=True)}
    declared = {"meshes": {"ball": bumpy_sphere(3)}, "attacks": attacks, "payloads": [16], "budgets": [BUDGET]}
    return jm.Study(**{**declared, "samples": 2, **changes})


@pytest.fixture(scope="module")
def output(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("study") / "results.jsonl"


@pytest.fixture(scope="module")
def results(output) -> Results:
    return study().run(output)


def without_seconds(rows: tuple[Row, ...]) -> list[Row]:
    return [row._replace(seconds=0) for row in rows]


@pytest.mark.slow
def test_rows_are_what_marker_attack_and_detect_say(results):
    mesh, found = bumpy_sphere(3), {(row.attack, row.strength, row.seed, row.control): row for row in results.rows}
    assert len(found) == len(results.rows) == 3 * 2 * 3
    keys = [jm.Key(hashlib.shake_256(f"jaxmark/study/key/{seed}".encode()).digest(32)) for seed in range(3)]
    markers = [jm.make_marker(mesh, key, bits=16) for key in keys]
    for seed in range(2):
        message = hashlib.shake_256(f"jaxmark/study/message/{seed}".encode()).digest(2)
        marked, info = markers[seed].embed(message, jm.Budget(rms=BUDGET, noise=0))
        for kind, strength in (("noise", 0.002), ("noise", 0.2), ("stretch", 0.1)):
            attack = study().attacks[kind] if kind == "stretch" else kind
            for control, before, marker in (
                ("marked", marked, markers[seed]),
                ("wrong-key", marked, markers[seed + 1]),
                ("unmarked", mesh, markers[seed]),
            ):
                row = found[kind, strength, seed, control]
                one = marker.detect(jm.attack(before, attack, strength, seed=seed))
                # Attacks at once round otherwise than one by one.
                assert row.log10_p == pytest.approx(one.log10_p, abs=0.05)
                assert row.log10_p_unfloored == pytest.approx(one.evidence.log10_p_unfloored, rel=0.01, abs=0.05)
                assert row.read == (one.message == message)
                assert row.detected == (one.log10_p <= -6)
                assert row.rms == (0 if control == "unmarked" else info.rms)
                assert row.refusal == ""
    assert [found["noise", 0.002, seed, "marked"].read for seed in range(2)] == [True, True]
    assert found["stretch", 0.1, 0, "marked"].bit_errors == 0
    assert not found["noise", 0.2, 0, "marked"].read
    assert found["stretch", 0.1, 0, "marked"].unit == "share of the height"
    assert found["noise", 0.2, 0, "marked"].unit == jm.adversaries.ATTACKS["noise"].unit


def test_controls_are_always_there_and_never_read(results):
    for rate in results.rates(["control"]):
        assert rate["trials"] == 6
        if rate["control"] != "marked":
            assert (rate["read"], rate["detected"], rate["detected_low"]) == (0, 0, 0)
            assert rate["detected_high"] == pytest.approx(1 - 0.025 ** (1 / 6))


@pytest.mark.long
def test_a_study_that_is_ended_goes_on(results, output, tmp_path):
    again, said = tmp_path / "again.jsonl", []

    def interrupt(line: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study().run(again, log=interrupt)
    assert len(load_finished(again)) < 3
    assert without_seconds(study().run(again, log=said.append).rows) == without_seconds(results.rows)
    # What is finished is not done again: the seconds are the same, too.
    assert study().run(again, log=said.append).rows == study().run(again, log=said.append).rows
    assert len(said) == 3 - 1 or len(said) == 3 - 2
    # A wider study takes over what it shares, another mesh of the same name does not.
    said.clear()
    study(attacks={"noise": [0.002]}).run(again, log=said.append)
    assert said == []
    study(attacks={"noise": [0.002]}, meshes={"ball": bumpy_sphere(3, seed=1)}, samples=1).run(again, log=said.append)
    assert len(said) == 1


def test_keys_are_neither_stored_nor_printed(results, output, tmp_path):
    results.save_csv(tmp_path / "results.csv")
    text = output.read_text() + (tmp_path / "results.csv").read_text() + results.markdown() + repr(results)
    for seed in range(3):
        key = hashlib.shake_256(f"jaxmark/study/key/{seed}".encode()).digest(32)
        assert key.hex() not in text
        assert repr(bytes(key)) not in text


def test_what_is_refused_is_in_the_rows_and_ends_nothing(tmp_path):
    attacks = {"picky": Attack(picky, "none", (1.0,), host=True)}
    found = study(attacks=attacks).run(tmp_path / "refused.jsonl")
    for row in found.rows:
        assert row.refusal == ("Not attacked: Not this one." if row.control == "unmarked" else "")
        assert row.read == (row.control == "marked")
        if row.refusal:
            assert (row.read, row.detected, row.bit_errors, row.log10_p) == (False, False, 0.5, 0)
    assert "picky 1, unmarked, 2 ×: Not attacked: Not this one." in found.markdown()
    # Too many bits: no marker, and so nothing to read with.
    full = study(attacks={"noise": [0.002]}, payloads=[4096]).run(tmp_path / "full.jsonl")
    assert {row.refusal.split(":")[0] for row in full.rows} == {"Not marked"}
    assert {row.rms for row in full.rows} == {0}


@pytest.mark.long
def test_what_cannot_be_aligned_is_in_the_rows(tmp_path):
    attacks = {"lost": Attack(scattered, "none", (1.0,), host=True)}
    found = study(attacks=attacks, samples=1).run(tmp_path / "lost.jsonl")
    assert len(found.rows) == 3
    assert all("could not be aligned" in row.refusal for row in found.rows)


@pytest.mark.long
def test_processes_and_files_give_the_same(results, tmp_path):
    mesh = bumpy_sphere(3)
    jm.save_mesh(mesh, tmp_path / "ball.obj")
    declared = study(attacks={"noise": [0.002, 0.2]}, meshes={"ball": tmp_path / "ball.obj"})
    found = declared.run(tmp_path / "results.jsonl", workers=2)
    assert without_seconds(found.rows) == [row for row in without_seconds(results.rows) if row.attack == "noise"]
    unknown = study(attacks={"mine": Attack(lambda mesh, strength, key: mesh, "none", (1.0,))})
    with pytest.raises(jm.JaxmarkError, match="cannot be sent to other processes"):
        unknown.run(tmp_path / "results.jsonl", workers=2)


def test_studies_can_be_sent_to_workers():
    assert pickle.loads(pickle.dumps(study())).payloads == [16]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"meshes": {}}, "at least one mesh"),
        ({"attacks": {"noise": []}}, "at least one strength of 'noise'"),
        ({"attacks": {"melting": [1.0]}}, "no attack 'melting'"),
        ({"schemes": ["magic"]}, "no scheme 'magic'"),
        ({"budgets": [{"beauty": 1.0}]}, "no metric 'beauty'"),
        ({"budgets": [-1.0]}, "budget is relative"),
        ({"payloads": [12]}, "multiple of 8 bits, got 12"),
        ({"samples": 0}, "at least one sample"),
    ],
)
def test_what_is_no_study(changes, sentence):
    with pytest.raises(jm.JaxmarkError, match=sentence):
        study(**changes)


def test_no_worker_and_no_file(tmp_path):
    with pytest.raises(jm.JaxmarkError, match="at least one worker"):
        study().run(tmp_path / "results.jsonl", workers=0)
    with pytest.raises(jm.JaxmarkError, match=r"absent\.ply"):
        study(meshes={"absent": tmp_path / "absent.ply"}).run(tmp_path / "results.jsonl")


def made_up(count: int, **fields) -> list[Row]:
    row = Row(
        "m", "keyed", 64, "0.001", "noise", 0.1, "u", 0, "marked", True, False, 0.0, -20.0, -20.0, True, "", 1.0, 1e-3
    )
    return [row._replace(seed=seed, **fields) for seed in range(count)]


def test_rates_pool_what_is_not_named():
    rows = [*made_up(3), *made_up(1, read=False, bit_errors=0.5, log10_p=-2.0, detected=False), *made_up(2, mesh="n")]
    table = Results(tuple(rows))
    (both, other) = table.rates(["mesh"])
    assert (both["mesh"], both["read"], both["trials"]) == ("m", 3, 4)
    assert (both["read_low"], both["read_high"]) == tuple(map(float, clopper_pearson(3, 4)))
    assert (both["bit_errors"], both["log10_p"], both["log10_p_largest"]) == (0.125, -20, -2)
    assert both["log10_p_unfloored_least"] == -20
    assert (other["mesh"], other["trials"]) == ("n", 2)
    (all_of_them,) = table.rates([])
    assert (all_of_them["read"], all_of_them["detected"], all_of_them["trials"]) == (5, 5, 6)
    with pytest.raises(jm.JaxmarkError, match="no field 'colour'"):
        table.rates(["colour"])


def test_controls_that_were_not_read_are_not_counted():
    rows = [*made_up(2), *made_up(2, control="unmarked", detected=False, refusal="Not attacked: Not this one.")]
    rows += made_up(3, control="wrong-key", detected=False)
    text = Results(tuple(rows)).markdown()
    assert "| 0/0 | 0/3 |" in text
    assert "unmarked, detected" not in text.split("|")[-1]


def test_controls_and_marks_are_never_pooled():
    controls = [row for name in ("unmarked", "wrong-key") for row in made_up(3, control=name, read=False)]
    found = Results((*made_up(3), *controls)).rates(["attack"])
    assert {rate["control"]: (rate["read"], rate["trials"]) for rate in found} == {
        "marked": (3, 3),
        "unmarked": (0, 3),
        "wrong-key": (0, 3),
    }


def test_keys_of_ones_own_are_taken_in_turn(key: jm.Key, tmp_path):
    other = jm.Key(bytes(range(1, 33)))
    own = study(attacks={"noise": [0.002]}, samples=3, keys=[key, other])
    rows = own.run(tmp_path / "results.jsonl").rows
    assert [row.read for row in rows if row.control == "marked"] == [True] * 3
    assert not any(row.read for row in rows if row.control != "marked")
    assert not {cell[-1] for cell in own._cells()} & {cell[-1] for cell in study(keys=[key])._cells()}
    assert key.hex() not in (tmp_path / "results.jsonl").read_text()
    with pytest.raises(jm.JaxmarkError, match="32 bytes"):
        study(keys=[b"short"])


def test_lines_of_meshes_are_apart_and_the_legend_fits():
    pytest.importorskip("matplotlib")
    rows = [row for name in ("a mesh with a long name", "b", "c") for row in made_up(2, mesh=name, budget=8e-4)]
    rows += made_up(2, mesh="b", budget="dame=0.008, careful look") + made_up(2, control="unmarked", read=False)
    figure = Results(tuple(rows)).plot().figure
    figure.draw_without_rendering()
    (axes,) = figure.axes
    labels = {container.get_label() for container in axes.containers}
    names = ("a mesh with a long name", "b", "c")
    assert {f"keyed, {name}, 0.0008 of the diagonal" for name in names} | {
        "keyed, b, dame=0.008, careful look"
    } < labels
    (legend,) = figure.legends
    box, page = legend.get_window_extent(), figure.bbox
    assert page.x0 <= box.x0 < box.x1 <= page.x1
    assert page.y0 <= box.y0 < box.y1 <= axes.get_tightbbox().y0


@pytest.mark.parametrize(
    ("attack", "strength", "size"),
    [
        ("noise", 0.02, lambda moved: np.abs(moved).max()),
        ("gaussian-noise", 0.02, lambda moved: np.sqrt(np.mean(moved**2))),
        ("diagonal-noise", 0.02, lambda moved: np.abs(moved).max()),
        ("warp", 0.02, lambda moved: np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
    ],
)
def test_strengths_that_are_lengths_are_fractions_of_the_diagonal(attack, strength, size):
    """The length is that of the displacement that the attack makes, also where a mesh has seams."""
    ball = bumpy_sphere(3)
    apart = Mesh(
        np.asarray(ball.vertices)[np.asarray(ball.faces).ravel()], np.arange(3 * len(ball.faces)).reshape(-1, 3)
    )
    for mesh in (ball, apart):
        moved = np.asarray(jm.attack(mesh, attack, strength, seed=0).vertices) - np.asarray(mesh.vertices)
        length = jm.adversaries.ATTACKS[attack].length(strength, mean_distance(mesh))
        assert length == pytest.approx(size(moved) / diagonal(mesh), rel=0.03)


def test_strengths_that_are_no_lengths_keep_their_unit():
    assert jm.adversaries.ATTACKS["smoothing"].length(10, 0.3) is None


def test_noise_and_budgets_have_one_unit_in_pictures():
    pytest.importorskip("matplotlib")
    unit = jm.adversaries.ATTACKS["noise"].unit
    rows = [
        row
        for mesh, distance in (("a", 0.2), ("b", 0.3))
        for strength in (0.001, 0.01)
        for row in made_up(2, mesh=mesh, strength=strength, length=distance * strength, unit=unit)
    ]
    rows += made_up(1, mesh="refused", strength=0.001, unit=unit, refusal="It has no faces.")
    (axes,) = Results(tuple(rows)).plot().figure.axes
    assert axes.get_xlabel() == "half width over the diagonal"
    lines = {container.get_label(): container.lines[0].get_xdata() for container in axes.containers}
    np.testing.assert_allclose(lines["keyed, a"], [0.0002, 0.002])
    np.testing.assert_allclose(lines["keyed, b"], [0.0003, 0.003])
    np.testing.assert_allclose(lines["keyed, refused"], [0.00025])
    np.testing.assert_allclose(axes.get_xticks(), [0.00025, 0.0025])


def test_tables(results, tmp_path):
    results.save_csv(tmp_path / "results.csv")
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(results.rows)
    assert [float(row["log10_p"]) for row in rows] == [row.log10_p for row in results.rows]
    lines = results.markdown().splitlines()
    assert lines[0].startswith("| mesh | scheme | bits | budget, RMS over the diagonal or limits | attack | strength |")
    length = f"{0.002 * mean_distance(bumpy_sphere(3)):.2g}"
    start = f"| ball | keyed | 16 | 0.002 | noise | 0.002 | 0.002 | {length} | 2/2 | 16 - 100 | 0.0 % | -"
    assert lines[2].startswith(start)
    assert "| stretch | 0.1 | 0.002 | - |" in results.markdown()  # its unit is no length
    assert lines[2].endswith("| 0/2 | 0/2 |")
    assert any(line.startswith("unmarked, detected: 0/6, 95 % interval up to 45.9 %") for line in lines)


def test_frame(results):
    pytest.importorskip("pandas")
    frame = results.frame()
    assert tuple(frame.columns) == Row._fields
    assert set(frame.budget) == {BUDGET}
    assert frame.groupby("control").read.sum().to_dict() == {"marked": 4, "unmarked": 0, "wrong-key": 0}


@pytest.mark.parametrize("of", ["read", "log10_p", "log10_p_unfloored"])
def test_pictures(results, tmp_path, of):
    pytest.importorskip("matplotlib")
    rows = (*results.rows, *(row._replace(scheme="host", bits=32) for row in results.rows))
    Results(rows).plot(of).save(tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(jm.JaxmarkError, match="does not exist"):
        results.plot(of).save(tmp_path / "no" / "curves.png")


@pytest.mark.parametrize("strengths", [(0.005,), (0.001, 0.005), (11.0, 8.0), (0.0, 1.0)])
@pytest.mark.parametrize("of", ["read", "log10_p", "log10_p_unfloored"])
def test_series_that_agree_stand_side_by_side(of, strengths):
    pytest.importorskip("matplotlib")
    rows = [
        row
        for strength in strengths
        for scheme in ("keyed", "host")
        for row in (
            *made_up(2, scheme=scheme, strength=strength, log10_p=-77.0, log10_p_unfloored=-90.0),
            *made_up(2, scheme=scheme, strength=strength, control="unmarked", detected=False, log10_p=0.0),
            *made_up(2, scheme=scheme, strength=strength, control="wrong-key", detected=False, log10_p=0.0),
        )
    ]
    picture = Results(tuple(rows)).plot(of)
    picture.figure.draw_without_rendering()  # lays it out
    (axes,) = picture.figure.axes
    series = {container.get_label(): container.lines[0] for container in axes.containers}
    suffix = ", detected" if of == "read" else ""
    assert list(series) == ["keyed", "host", f"unmarked{suffix}", f"another key{suffix}"]
    middle = axes.transData.transform([(strength, 0.0) for strength in strengths])[:, 0]
    places = []
    for line in series.values():
        np.testing.assert_array_equal(line.get_xdata(), strengths)
        on_page = line.get_transform().transform(line.get_xydata())
        assert all(axes.bbox.contains(*point) for point in on_page)  # nothing is cut off
        places.append(on_page[:, 0] - middle)
    assert (np.diff(places, axis=0) > 5).all()  # pixels
    np.testing.assert_allclose(np.sum(places, axis=0), 0, atol=1e-6)
    bottom, top = axes.get_ylim()
    written = [text.get_text() for text in axes.texts]
    if of == "read":
        assert bottom < top
        assert not written
        assert axes.get_ylabel() == "share read of 2, 95 % interval"
    else:
        assert bottom > top  # more evidence is higher
        assert written == ["detected from here up", "floor of what a key can prove"][: 1 + (of != "log10_p")]


def test_a_page_of_a_study_has_all_of_it_and_loads_nothing(tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    refused = made_up(1, mesh="<b>", read=False, detected=False, log10_p=0.0, refusal="It has no faces.")
    rows = (*made_up(2), *refused)
    rows = tuple(row._replace(control=control) for row in rows for control in ("marked", "unmarked", "wrong-key"))
    results = Results(rows)
    results.save_page(tmp_path / "study.html", "A & B")
    page = (tmp_path / "study.html").read_text()
    assert page.count("A &amp; B") == 2
    assert not re.search(r"<script|<link|@import|https?:", page)
    shown = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert [base64.b64decode(png) for png in shown] == [results.plot(of).png() for of in ("read", "log10_p_unfloored")]
    lines = [re.findall("<t[dh]>([^<]*)</t[dh]>", line) for line in re.findall("<tr>.*</tr>", page)]
    written = [line.strip("| ").split(" | ") for line in results.markdown().splitlines() if line.startswith("| ")]
    assert [[html.unescape(cell) for cell in line] for line in lines] == written
    assert "<li>&lt;b&gt;, keyed, noise 0.1, marked, 1 ×: It has no faces.</li>" in page
    assert "unmarked, detected: 2/2, 95 % interval up to 100 %" in page


TOML = 'samples = 1\npayloads = [16]\nbudgets = [0.002]\n[meshes]\nball = "small.ply"\n[attacks]\nnoise = [0.002]\n'


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "Cannot read study.toml"),
        ("samples = = 1", "study.toml is no TOML"),
        (f"samples = {'[' * 5000}", "study.toml is no TOML: it is nested too deeply"),
        (f"samples = {'9' * 5000}", "study.toml is no TOML: "),
        (TOML.replace("[0.002]\n[m", f"[{'9' * 400}]\n[m"), "study.toml: "),
        (TOML.replace("noise = [0.002]", f"noise = [{'9' * 400}]"), "study.toml: one of its numbers is too large"),
        ("samples = 1", "declares no meshes"),
        ('meshes = {a = "a.ply"}', "declares no attacks"),
        (TOML + "[colours]\na = 1", "no field 'colours'"),
        (TOML.replace("[0.002]\n[m", '["much"]\n[m'), "study.toml: visibility is one of 'hidden'"),
        (TOML.replace("[0.002]\n[m", "[true]\n[m"), "budgets must be a list of numbers"),
        (TOML.replace("samples = 1", "samples = true"), "samples must be a whole number"),
        (TOML.replace('"small.ply"', "3"), "meshes must be a table of files"),
        (TOML.replace("noise", "melting"), "study.toml: There is no attack 'melting'"),
        (TOML.replace("small", "absent"), r"absent\.ply"),
    ],
)
def test_files_that_declare_no_study(tmp_path, monkeypatch, capfd, text, sentence):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    if text is not None:
        Path("study.toml").write_text(text)
    code, out, err = workshop("study", "study.toml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert sentence.replace("\\", "") in err


@pytest.mark.usefixtures("unchecked")
def test_a_study_from_a_file(tmp_path, monkeypatch, capfd):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    Path("declared").mkdir()
    jm.save_mesh(bumpy_sphere(3), "declared/small.ply")
    Path("declared/study.toml").write_text(TOML)
    assert load_study("declared/study.toml").meshes == {"ball": Path("declared/small.ply")}
    code, out, err = workshop("study", "declared/study.toml", "--output", "left")
    assert code == 0, err
    assert err == ""  # progress is for terminals
    assert re.search(r"\| ball \| keyed \| 16 \| 0\.002 \| noise \| 0\.002 \| 0\.002 \| [\d.]+ \| 1/1 \|", out)
    assert Path("left/rates.md").read_text() == out
    assert "<td>ball</td><td>keyed</td>" in Path("left/study.html").read_text()
    told = workshop.json("study", "declared/study.toml", "--output", "left")
    assert told["readings"] == 3
    assert [rate["read"] for rate in told["rates"]] == [1, 0, 0]
    assert len(Path("left/results.csv").read_text().splitlines()) == 4
    assert len([json.loads(line) for line in Path("left/results.jsonl").read_text().splitlines()]) == 1


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("part", ["meshes", "attacks"])
def test_meshes_and_attacks_have_names(part):
    with pytest.raises(jm.JaxmarkError, match=f"The {part} of a study have names: give them as a mapping, such as"):
        study(**{part: ["noise"]})
