"""Copies for recipients: colluders are found, innocents are not."""

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh
from tests.samples import bumpy_sphere

NAMES = [f"recipient {i}" for i in range(2000)]


@pytest.fixture(scope="module")
def tracer(key: jm.Key) -> jm.watermark.Tracer:
    return jm.watermark.make_tracer(bumpy_sphere(4), key)


@pytest.fixture(scope="module")
def copies(tracer: jm.watermark.Tracer) -> np.ndarray:
    return np.stack([tracer.fingerprint(name, 8e-4)[0].vertices for name in NAMES[:4]])


def accused(tracer: jm.watermark.Tracer, vertices: np.ndarray) -> set[str]:
    suspect = tracer.mark.original.mesh._replace(vertices=vertices)
    return {one.recipient for one in tracer.identify(suspect, NAMES) if one.log10_p <= -6}


def test_a_copy_names_its_recipient(tracer: jm.watermark.Tracer, copies: np.ndarray):
    mesh = tracer.mark.original.mesh
    for name, vertices in zip(NAMES, copies, strict=False):
        assert accused(tracer, vertices) == {name}
        length = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
        assert np.sqrt(np.mean(np.sum((vertices - mesh.vertices) ** 2, axis=1))) / length == pytest.approx(8e-4)
    noisy = jm.attack(mesh._replace(vertices=copies[0]), "noise", 0.005, seed=0)
    assert accused(tracer, noisy.vertices @ np.diag([1, 2, 0.5])) == {NAMES[0]}


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("kind", ["average", "mix of vertices", "median"])
def test_colluders_are_found(tracer: jm.watermark.Tracer, copies: np.ndarray, count, kind):
    mine = copies[:count]
    who = np.random.default_rng(0).integers(count, size=mine.shape[1])
    vertices = {
        "average": mine.mean(axis=0),
        "mix of vertices": mine[who, np.arange(mine.shape[1])],
        "median": np.median(mine, axis=0),
    }[kind]
    found = accused(tracer, vertices)
    assert found
    assert found <= set(NAMES[:count])


@pytest.mark.long
def test_nobody_is_accused_by_strangers(tracer: jm.watermark.Tracer, copies: np.ndarray):
    mesh = tracer.mark.original.mesh
    other = jm.watermark.make_tracer(mesh, jm.new_key())
    message, _ = jm.embed(mesh, b"message", tracer.mark.key)
    for vertices in (mesh.vertices, other.fingerprint(NAMES[0])[0].vertices, message.vertices):
        assert accused(tracer, vertices) == set()
    # Four copies, of recipients who are not on the list.
    suspect = mesh._replace(vertices=copies.mean(axis=0))
    assert all(one.log10_p > -3 for one in tracer.identify(suspect, NAMES[4:]))


@pytest.mark.slow
def test_functions_and_record(key: jm.Key):
    mesh = bumpy_sphere(3)
    copy, info = jm.fingerprint(mesh, "alice", key)
    assert info.record.content == "fingerprint"
    found = jm.identify(copy, ["bob", "alice"], original=mesh, key=key, record=info.record, top=1)
    assert found[0].recipient == "alice"
    charge, *_ = found[0].charges  # and those of record and alignment
    assert (charge.choice, charge.log10) == ("recipient", pytest.approx(np.log10(2)))
    with pytest.raises(jm.JaxmarkError, match="identify reads it"):
        jm.detect(copy, original=mesh, key=key, record=info.record)
    _, message = jm.embed(mesh, b"x", key)
    with pytest.raises(jm.JaxmarkError, match="detect reads it"):
        jm.identify(copy, ["alice"], original=mesh, key=key, record=message.record)
    with pytest.raises(jm.JaxmarkError, match="key is not the one"):
        jm.identify(copy, ["alice"], original=mesh, key=jm.new_key(), record=info.record)
    with pytest.raises(jm.JaxmarkError, match="empty"):
        jm.fingerprint(mesh, "", key)


def test_too_small_a_mesh_is_refused(key: jm.Key):
    tiny = Mesh(bumpy_sphere(1).vertices[:4], np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]))
    with pytest.raises(jm.JaxmarkError, match="cannot carry a fingerprint"):
        jm.fingerprint(tiny, "alice", key)


@pytest.mark.slow
def test_a_copy_names_its_recipient_however_the_name_is_typed(tracer: jm.watermark.Tracer):
    vertices = tracer.fingerprint("A\u030alice ", 8e-4)[0].vertices
    suspect = tracer.mark.original.mesh._replace(vertices=vertices)
    for name in ("Ålice", "\ufeffA\u030alice"):
        first, _ = tracer.identify(suspect, ["bob", name])
        assert (first.recipient, first.log10_p <= -6) == ("Ålice", True)
    # Earlier versions wrote such names as they are.
    aligned = tracer.register(suspect)
    assert tracer.rank(aligned, ["Ålice"]) == tracer.read(aligned, ["Ålice"])
    with pytest.raises(jm.JaxmarkError, match="cannot be seen"):
        tracer.identify(suspect, ["Ålice", "Ålice "])
