"""What people get wrong in Python is told in one sentence of the library's own, when the object is made."""

import json
import pydoc
import textwrap
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.attacks import Attack
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark import FieldScheme, HostScheme, KeyedScheme, LocalScheme, detect_bits, embed_bits, log_evidence
from jaxmark.watermark.carriers import KeyedCarrier
from jaxmark.watermark.record import Record
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

MESH, KEY, LINES = bumpy_sphere(2), jm.Key(bytes(32)), 45
PRESENCE = Record("keyed", 0, 0.1, "", "0" * 64, content="presence")
ATTACKS = {"noise": [0.005]}
WEAK = {"meshes": {"a": MESH}, "attacks": ATTACKS}


def mine(mesh: Mesh, strength: float, randomness: object) -> Mesh:
    return mesh


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: jm.Study([MESH], ATTACKS), "The meshes of a study have names: give them as a mapping"),
        (lambda: jm.Study({"a": MESH}, ["noise"]), r'have names: give them as a mapping, such as {"noise": \[0.005\]}'),
        (lambda: jm.Study({"a": 3}, ATTACKS), "The mesh 'a' of a study is a Mesh or a file, got int"),
        (lambda: jm.Study({"a": MESH}, {"mine": mine}), "An attack is a name of ATTACKS or an Attack, .* got 'mine'"),
        (lambda: jm.Study({"a": MESH}, {"noise": 0.1}), "strengths of the attack 'noise' are a list, .* got 0.1"),
        (lambda: jm.Study({"a": MESH}, {"noise": ["much"]}), "'noise' are finite and not negative, got 'much'"),
        (lambda: jm.Study(**WEAK, schemes="keyed"), "The schemes of a study are a list, .* got 'keyed'"),
        (lambda: jm.Study(**WEAK, payloads=64), r"The payloads of a study are a list, such as \[32, 64\], got 64"),
        (lambda: jm.Study(**WEAK, payloads=["8"]), "positive multiple of 8 bits, got '8'"),
        (lambda: jm.Study(**WEAK, budgets=8e-4), "The budgets of a study are a list, .* got 0.0008"),
        (lambda: jm.Study(**WEAK, samples=[0, 1]), r"samples is a whole number, such as 5, got \[0, 1\]"),
        (lambda: jm.robustness(None, MESH, b"", mine), "name of ATTACKS or an Attack, .* got 'mine'"),
        (lambda: jm.attack(MESH, "noise", "much", seed=0), "strength of an attack must be a number .* got 'much'"),
        (
            lambda: jm.attack(MESH, "noise", 0.1, seed=None),
            "seed must be a whole number, .* or a random key of JAX, got None",
        ),
        (lambda: jm.embed("model.ply", b"x", KEY), "A mesh is needed, got str; jaxmark.load_mesh reads one"),
        (lambda: jm.detect("model.ply", key=KEY), "A mesh is needed, got str"),
        (lambda: jm.detect(MESH, original="model.ply", key=KEY), "A mesh is needed, got str"),
        (lambda: jm.compare("model.ply", MESH), "A mesh is needed, got str"),
        (lambda: jm.embed(MESH, "hello", KEY), "A message is bytes, got str"),
        (lambda: jm.detect(MESH, original=MESH, key=KEY, bits="64"), "must be a multiple of 8 bits, got '64'"),
        (lambda: jm.detect(MESH, key=KEY, bits=64.0), "must be a multiple of 8 bits, got 64.0"),
        (lambda: jm.detect(MESH, key=KEY, record="r.json"), "record of a mesh is needed, got str; Record.load reads"),
        (lambda: jm.make_marker(MESH, KEY, record={}), "The record of a mesh is needed, got dict"),
        (lambda: jm.identify(MESH, ["a"], original=MESH, key=KEY, record={}), "The record of a mesh is needed"),
        (
            lambda: jm.detect(MESH, key=KEY, record=PRESENCE, scheme="field"),
            "'field' contradicts the record",
        ),
        (lambda: jm.embed(MESH, b"x", KEY, scheme=("keyed", 3)), r"not \('keyed', 3\)"),
        (lambda: jm.embed(MESH, b"x", KEY, scheme=()), r"Several marks in one mesh need .*, not \(\)"),
        (lambda: jm.embed(MESH, b"x", KEY, budget=[]), r"in \(0, 1\), got \[\]"),
        (lambda: jm.embed(MESH, b"x", KEY, budget={1: 2}), "A metric to limit is a name or a function, got 1"),
        (lambda: jm.embed(MESH, b"x", KEY, budget=np.array([8e-4])), r"in \(0, 1\), got array"),
        (
            lambda: jm.identify(MESH, ["a"], original=MESH, key=KEY, top=-1),
            "top is a whole number .*, got -1",
        ),
        (lambda: jm.identify(MESH, ["a"], original=MESH, key=KEY, top="x"), "top is a whole number .*, got 'x'"),
        (lambda: Record.load(None), "A path is needed, got NoneType"),
        (lambda: jm.attack(MESH, "noise", 0.1, seed=2**70), "A seed must be from 0 to"),
        (lambda: jm.Budget(noise=True), "a number of at least 0, got True"),
        (lambda: jm.detect(MESH, original=MESH, key=KEY, scheme=5), "A scheme is a name, or one of"),
        (lambda: jm.detect(MESH, original=MESH, key=KEY, scheme=["keyed"], record=PRESENCE), "A scheme is a name, or"),
        (lambda: jm.Budget(rms="a"), r"in \(0, 1\), got 'a'"),
        (lambda: jm.Budget(noise="a"), "a number of at least 0, got 'a'"),
        (lambda: jm.Budget(limits=["dame"]), r'as a mapping, such as {"dame": 0.01}, got'),
        (lambda: jm.Budget(limits={"dame": None}), "limit of dame must be a positive number, got None"),
        (lambda: jm.capacity(MESH, coverage="1"), r"a coverage in \(0, 1\], got '1'"),
        (lambda: jm.fingerprint(MESH, 5, KEY), "A name is text, got 5"),
        (lambda: jm.identify(MESH, [1], original=MESH, key=KEY), "A name is text, got 1"),
        (lambda: jm.identify(MESH, [], original=MESH, key=KEY), "No recipient is given"),
        (lambda: jm.identify(MESH, None, original=MESH, key=KEY), "Names are a list, got None"),
        (lambda: jm.load_mesh(None), "A path is needed, got NoneType"),
        (lambda: jm.attack(MESH, "noise", 0.1, seed=-1), "A seed must be from 0 to .*, got -1"),
        (
            lambda: jm.detect(MESH, original=MESH, key=KEY, message=b"abc", bits=64),
            "has 24 bits, but the payload is 64",
        ),
        (lambda: KeyedScheme(profile=(1.0,) * 65), "A profile is up to 64 finite numbers, .* got 65"),
        (lambda: LocalScheme(steps=()), r"The steps of 'local' are a tuple of positive numbers, got \(\)"),
        (lambda: FieldScheme(widths=0.01), "The widths of 'field' are a tuple of positive numbers, got 0.01"),
        (lambda: FieldScheme(steps=(0.1, -1.0)), r"The steps of 'field' are .*, got \(0.1, -1.0\)"),
        (lambda: KeyedScheme(direction="up"), "direction must be 'coordinates' or 'normals', got 'up'"),
    ],
)
def test_what_is_wrong_is_told(call: Callable[[], object], sentence: str):
    with pytest.raises(jm.JaxmarkError, match=sentence) as refusal:
        call()
    assert "\n" not in str(refusal.value)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("scheme", [KeyedScheme(), HostScheme(16)], ids=lambda scheme: scheme.name)
def test_arrays_of_another_length_are_told(scheme: KeyedScheme | HostScheme):
    marker = jm.make_marker(MESH, KEY, bits=0, scheme=scheme)
    carrier, x = marker.carrier, marker.original.signal
    bits, bands = jnp.ones(carrier.code_bits), jnp.ones(99)
    for call, sentence in (
        (lambda: embed_bits(x, bits, carrier, bands), r"beta is one number, \d+ numbers .* got the shape \(99,\)"),
        (lambda: embed_bits(x, jnp.ones(99), carrier, 1.0), r"This carrier has 1 code bits; got the shape \(99,\)"),
        (lambda: detect_bits(x[:-1], x, carrier), r"rows in its order, and so must the suspect; got the shape"),
        (lambda: detect_bits(x, x, carrier, weights=bands), r"and so must weights; got the shape \(99,\)"),
        (lambda: detect_bits(x, x, carrier, beta=bands), "beta is one number"),
        (lambda: log_evidence(x, x, carrier, jnp.ones(99)), "This carrier has 1 code bits"),
    ):
        with pytest.raises(jm.JaxmarkError, match=sentence):
            call()


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_numpy_and_jax_are_numbers():
    mesh = bumpy_sphere(3)
    for rms in (np.float32(1e-3), jnp.float32(1e-3), np.array(1e-3)):
        marked, info = jm.embed(mesh, b"", KEY, budget=jm.Budget(rms=rms, limits={"dame": np.float32(0.1)}))
        assert json.loads(info.record.to_json())["bits"] == 0
    assert jm.detect(marked, original=mesh, key=KEY, bits=np.int64(0), record=info.record).detected()
    assert jm.detect(marked, original=mesh, key=KEY, bits=np.int64(0)).detected()


@pytest.mark.usefixtures("unchecked")
def test_bands_of_another_number_are_told():
    carrier = jm.make_marker(MESH, KEY, bits=0).carrier
    assert isinstance(carrier, KeyedCarrier)
    with pytest.raises(jm.JaxmarkError, match=r"with_bands needs \d+ strengths, one per band; got the shape \(99,\)"):
        carrier.with_bands(jnp.ones(99))


def test_attacks_on_the_host_are_given_a_generator_of_numpy():
    def shaken(mesh: Mesh, strength: float, random: np.random.Generator) -> Mesh:
        return mesh._replace(vertices=mesh.vertices + strength * random.normal(size=mesh.vertices.shape))

    attack = Attack(shaken, "standard deviation", (0.1,), host=True)
    once, again, other = (jm.attack(MESH, attack, 0.1, seed=seed).vertices for seed in (0, 0, 1))
    np.testing.assert_array_equal(once, again)
    assert (once != other).all()
    assert np.std(once - MESH.vertices) == pytest.approx(0.1, rel=0.2)


@pytest.mark.parametrize("name", ["detect", "embed", "capacity"])
def test_help_fits_a_screen(name: str):
    said = pydoc.plain(pydoc.render_doc(getattr(jm, name)))
    # From Python 3.13 on, each parameter has a line of its own, which says no more than one line does.
    head, text = said.split(") ->", 1)
    said = f"{' '.join(head.split())}) ->{text}"
    lines = [part for line in said.splitlines() for part in textwrap.wrap(line, 120) or [""]]
    assert len(lines) <= LINES
    assert "numpy._typing" not in said
    assert "typing." not in said


@pytest.mark.parametrize("described", [jm.Study, Attack, jm.watermark.Detection, jm.watermark.Evidence, jm.Budget])
def test_help_describes_all_fields(described: type):
    names = described._fields if hasattr(described, "_fields") else described.__dataclass_fields__
    _, _, attributes = (described.__doc__ or "").partition("Attributes:")
    for name in names:
        assert f"\n        {name}: " in attributes or f"\n    {name}: " in attributes
