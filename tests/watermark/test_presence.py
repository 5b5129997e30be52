"""Marks on small models: what they survive, and marks that say nothing but that they are there."""

from dataclasses import replace

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app.output import message_text
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.perception.capacity import NOISE
from tests.app.test_cli import MESSAGE, Workshop
from tests.samples import bumpy_sphere, rough_sphere


@pytest.fixture(scope="module")
def small() -> Mesh:
    return rough_sphere(110, 3)


def noisy(mesh: Mesh, noise: float, seed: int) -> Mesh:
    vertices = np.asarray(mesh.vertices)
    radius = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()
    return mesh._replace(
        vertices=vertices + noise * radius * np.random.default_rng(seed).uniform(-1, 1, vertices.shape)
    )


@pytest.mark.slow
def test_what_a_mark_survives_is_as_said(key: jm.Key):
    mesh = bumpy_sphere(3)
    marker = jm.make_marker(mesh, key, bits=16)
    marked, info = marker.embed(b"ok")
    assert info.survives.whole > 1.3 * info.survives.half > 0
    found = marker.measure_survival(marked, b"ok", info.survives)
    assert found is not None
    assert found.whole <= info.survives.whole
    assert 0.3 * info.survives.half < found.half <= info.survives.half
    assert sum(marker.detect(noisy(marked, found.whole, seed)).message == b"ok" for seed in range(4)) == 4
    assert sum(marker.detect(noisy(marked, 8 * found.whole, seed)).message == b"ok" for seed in range(4)) == 0
    # What is asked for can be had, and no more.
    marker.embed(b"ok", jm.Budget(noise=0.99 * info.survives.half))
    with pytest.raises(jm.JaxmarkError, match=r"budget of at least .*dame would be"):
        marker.embed(b"ok", jm.Budget(noise=1.2 * info.survives.half))


def test_a_model_that_meets_no_demand_is_marked(small: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match="at most"):
        jm.embed(small, b"k", key, budget=jm.Budget(noise=NOISE))
    marked, info = jm.embed(small, b"k", key)
    assert jm.detect(marked, original=small, key=key, record=info.record).detected()


def test_a_presence_mark_is_proven_where_messages_do_not_fit(small: Mesh, key: jm.Key):
    with pytest.raises(jm.JaxmarkError, match="do not fit"):
        jm.embed(small, bytes(40), key)
    marked, info = jm.embed(small, b"", key)
    assert (info.record.content, info.record.bits, info.record.message_commitment) == ("presence", 0, "")
    suspect = noisy(marked, 0.5 * info.survives.whole, 0)
    found = jm.detect(suspect, original=small, key=key, record=info.record)
    assert found.message is None
    assert found.detected()
    again = jm.detect(suspect, original=small, key=key, bits=0)
    assert again.log10_p == pytest.approx(found.log10_p, abs=0.1)  # without a record, three pass bands are charged
    # It pays for no messages, whether dated or not.
    assert found.evidence.log10_p_uncommitted == pytest.approx(min(0.0, found.log10_p + 64 * np.log10(2)), abs=0.05)
    for other in (
        jm.detect(small, original=small, key=key, bits=0),
        jm.detect(suspect, original=small, key=jm.new_key(), bits=0),
    ):
        assert not other.detected(0.01)
    with pytest.raises(jm.JaxmarkError, match="0 bits"):
        jm.detect(suspect, original=small, key=key, record=info.record, message=b"x")
    with pytest.raises(jm.JaxmarkError, match="record"):
        jm.detect(suspect, original=small, key=key, record=replace(info.record, bits=8))


def test_presence_is_not_found_by_chance(small: Mesh, key: jm.Key):
    """By Hoeffding's bound, one key of a hundred reaches 0.01 at most."""
    suspect = noisy(small, 0.002, 1)
    found = [
        jm.make_marker(small, jm.Key(bytes([number]) * 32), bits=0).detect(suspect).log10_p for number in range(30)
    ]
    assert sum(log10_p <= -1 for log10_p in found) <= 9  # three are expected at most; more have a chance of 0.1 %


@pytest.mark.usefixtures("unchecked")
def test_commands_on_presence(tmp_path, monkeypatch, capfd, small: Mesh):
    workshop = Workshop(tmp_path, monkeypatch, capfd)
    jm.save_mesh(small, "small.obj")
    told = workshop.json("embed", "small.obj", "marked.obj", "--key", "owner.key", "--presence")
    assert (told["content"], told["bits"]) == ("presence", 0)
    assert told["survives"].keys() == {"whole", "half"}
    read = ("--original", "small.obj", "--key", "owner.key")
    assert workshop.json("detect", "marked.obj", *read, "--record", "marked.obj.jaxmark.json")["detected"]
    assert workshop.json("detect", "marked.obj", *read, "--presence")["detected"]
    assert not workshop.json("detect", "small.obj", *read, "--presence", status=1)["detected"]
    both = ("--key", "owner.key", "--presence", "--message", MESSAGE)
    assert "--presence" in workshop.refused("embed", "small.obj", "out.obj", *both)
    twice = ("--key", "owner.key", "--text", "hello", "--message", MESSAGE)
    assert "either --message or --text" in workshop.refused("embed", "small.obj", "out.obj", *twice)
    assert "--presence" in workshop.refused("embed", "small.obj", "out.obj", "--key", "owner.key", "--text", "")
    assert "--presence" in workshop.refused("detect", "marked.obj", *read, "--presence", "--bits", "8")


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (b"hello", '68656c6c6f ("hello")'),
        ("Grüße".encode(), '4772c3bcc39f65 ("Grüße")'),
        (b"\xc0\xff", "c0ff"),
        (b"a\n", "610a"),
    ],
)
def test_messages_that_are_text_are_shown_as_text(message: bytes, text: str):
    assert message_text(message) == text
