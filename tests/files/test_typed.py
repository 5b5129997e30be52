"""Text that looks the same is the same: byte-order marks, accents in two forms, and what cannot be seen."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import jaxmark as jm
from jaxmark.app.cli import cli
from jaxmark.app.mark_files import pick
from jaxmark.app.options import read_recipients
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.study import load_study
from jaxmark.files import Scene
from jaxmark.files.typed import decode, find_name, normalise, normalise_names
from jaxmark.geometry.mesh import make_mesh

NAME = "Ålice"
DISGUISED = ["Ålice", "A\u030alice", " Ålice\t", "Ålice\xa0", "\ufeffÅlice", "Å\u200blice", "Ål\xadice", "Ålice\u200d"]
BESIDE = "x\u200cy"  # a joiner that does nothing in Latin script


@pytest.mark.parametrize("text", DISGUISED, ids=ascii)
def test_text_that_looks_the_same_is_the_same(text: str):
    assert normalise(text) == NAME
    assert normalise_names([text, text]) == [NAME]
    assert decode(b"\xef\xbb\xbf" + text.encode()) == text
    assert find_name(NAME, {text: 0, "other": 1}) == text


@pytest.mark.parametrize("text", ["Ålice", "two  words", "a\tb", "می\u200cخواهم", "\U0001f469\u200d\U0001f680", ""])
def test_visible_text_stays(text: str):
    assert normalise(text) == text


def test_all_spaces_are_one_kind():
    assert normalise("Åsa\u00a0Müller") == normalise("Åsa\u202fMüller") == "Åsa Müller"
    with pytest.raises(JaxmarkError, match="differ only in what cannot be seen"):
        normalise_names(["Åsa\u00a0Müller", "Åsa Müller"])


def test_a_useless_joiner_is_dropped():
    assert normalise(BESIDE) == "xy"


@pytest.mark.parametrize(
    ("names", "sentence"), [(["bob", NAME, "Ålice "], "cannot be seen"), (["caf\udce9"], "not text in UTF-8")]
)
def test_unclear_names_are_refused(names: list[str], sentence: str):
    with pytest.raises(JaxmarkError, match=sentence):
        normalise_names(names)


def test_an_exact_name_is_preferred_and_an_unclear_one_refused():
    assert find_name("a ", ["a", "a "]) == "a "
    assert find_name("b", ["a"]) is None
    with pytest.raises(JaxmarkError, match="look the same"):
        find_name(" a", ["a", "a "])


@pytest.mark.parametrize("text", DISGUISED, ids=ascii)
def test_lists_of_recipients(tmp_path: Path, text: str):
    path = tmp_path / "names.txt"
    for mark, end in ((b"", "\n"), (b"\xef\xbb\xbf", "\r\n")):
        path.write_bytes(mark + f"{text}{end}{end} {end}bob{end}".encode())
        assert read_recipients(path) == [NAME, "bob"]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(b"\xff\xfea\0", "names.txt: it is not text"), (b"\xef\xbb\xbf\n", "no recipient")],
)
def test_lists_without_recipients_are_refused(tmp_path: Path, content: bytes, sentence: str):
    path = tmp_path / "names.txt"
    path.write_bytes(content)
    with pytest.raises(JaxmarkError, match=sentence):
        read_recipients(path)


def test_meshes_are_selected_by_names_that_look_the_same():
    mesh = make_mesh(np.eye(3), [[0, 1, 2]])
    assert list(pick(Scene({"A\u030a": mesh, "b": mesh}, {}), ["Å"], Path("a.glb")).meshes) == ["A\u030a"]


def test_keys_and_studies_may_have_a_byte_order_mark(tmp_path: Path):
    key, study = tmp_path / "owner.key", tmp_path / "study.toml"
    key.write_bytes(b"\xef\xbb\xbf" + b"0a" * 32 + b"\r\n")
    assert jm.watermark.load_key(key) == jm.Key(b"\n" * 32)
    study.write_bytes(b"\xef\xbb\xbf[meshes]\na = 'a.ply'\n")
    with pytest.raises(JaxmarkError, match="declares no attacks"):
        load_study(study)


@pytest.mark.parametrize("text", ["\u200b", " \ufeff"])
def test_messages_that_cannot_be_seen_are_empty(text: str):
    refused = CliRunner().invoke(cli, ["embed", "a.ply", "b.ply", "--key", "owner.key", "--text", text])
    assert refused.exit_code == 2
    assert "the message is empty" in refused.output


def test_one_text_is_no_list_of_names() -> None:
    with pytest.raises(JaxmarkError, match="Names are a list, not one text"):
        normalise_names("alice")
