"""Bands of one's own: bound to record and keyed choices, so that what they prove is a proof."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark import spectral
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.own_bands import OwnBandsScheme
from jaxmark.watermark.schemes.registry import make_scheme, parameters_of
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.core

BANDS = spectral.bands.scaling(32, damping="jackson")[1:20]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return bumpy_sphere(3)


def test_a_mark_in_trained_bands_is_a_proof_with_its_record(mesh: Mesh, key: jm.Key, tmp_path):
    strengths = jnp.linspace(1, 0.2, len(BANDS))
    scheme = OwnBandsScheme.from_arrays(jnp.asarray(BANDS, jnp.float32), strengths)
    marked, info = jm.embed(mesh, b"ok", key, budget=jm.Budget(rms=8e-4, noise=0), scheme=scheme)
    (tmp_path / "record.json").write_text(info.record.to_json())
    record = jm.Record.load(tmp_path / "record.json")
    found = jm.detect(jm.attack(marked, "noise", 0.001, seed=0), original=mesh, key=key, record=record)
    assert found.message == b"ok"
    assert found.log10_p < -20
    assert not found.evidence.caveats
    carrier = jm.make_marker(mesh, key, record=record).carrier
    expected = np.asarray(BANDS, np.float32) * np.asarray(strengths)[:, None]
    coefficients = np.asarray(carrier.host.coefficients)  # pyright: ignore
    factor = np.abs(coefficients).max() / np.abs(expected).max()
    np.testing.assert_allclose(coefficients, factor * expected, rtol=1e-6)
    assert np.log2(factor) == pytest.approx(round(np.log2(factor)))  # exact in floating point
    assert jm.detect(mesh, original=mesh, key=key, record=record).log10_p == 0
    other = dataclasses.replace(record, key=jm.make_marker(mesh, jm.Key(bytes(32)), bits=16).choices.key.hex())
    with pytest.raises(jm.JaxmarkError, match="key"):
        jm.detect(marked, original=mesh, key=jm.Key(bytes(32)), record=other)


def test_other_bands_have_other_signs_and_an_edited_record_is_refused(mesh: Mesh, key: jm.Key):
    """So that nobody can search for bands that suit the signs."""
    one = OwnBandsScheme.from_arrays(BANDS)
    two = OwnBandsScheme.from_arrays(BANDS * np.linspace(1, 1 + 1e-12, len(BANDS))[:, None])
    marks = [jm.make_marker(mesh, key, bits=16, scheme=scheme) for scheme in (one, two)]
    first, second = (np.asarray(mark.carrier.chips.signs) for mark in marks)  # pyright: ignore
    assert 0.4 < np.mean(first[first != 0] != second[first != 0]) < 0.6
    _, info = marks[0].embed(b"ok", jm.Budget(rms=8e-4, noise=0), read_back="never")
    edited = dataclasses.replace(info.record, parameters=parameters_of(two))
    with pytest.raises(jm.JaxmarkError, match="edited"):
        jm.make_marker(mesh, key, record=edited)


def test_dimensions_are_those_of_the_library_s_bands(mesh: Mesh):
    """Of an ideal low-pass, by its edge; flat bands of the default scheme have about as many."""
    original = jm.alignment.make_original(mesh)
    low = OwnBandsScheme.from_arrays(spectral.bands.intervals(np.array([0, 0.5, 2]), 200)[:1])
    assert low.dimensions(original, 16) == pytest.approx(3 * original.density * 0.5 * 642, rel=0.05)
    flat = OwnBandsScheme.from_arrays(np.sum(spectral.bands.scaling(64, damping="jackson")[:20], axis=0)[None])
    ours = KeyedScheme(profile=(1.0,) * 20).dimensions(original, 16)
    assert flat.dimensions(original, 16) == pytest.approx(ours, rel=0.1)


@pytest.mark.parametrize(
    "filters",
    [
        (),
        ((),),
        ((1.0,), (1.0, 2.0)),
        ((0.0, 0.0),),
        ((np.inf,),),
        ((1e9,),),
        ((1e-9,),),
        ((np.nan, 1.0),),
        ((1.0,),) * 513,
        ((1.0,) * 513,),
        (("a",),),
        ((1j,),),
        (1.0, 2.0),
        (((1.0,),),),
        None,
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bands_that_are_none_are_refused(filters):
    with pytest.raises(jm.JaxmarkError, match="Own bands"):
        OwnBandsScheme(filters)


@pytest.mark.parametrize("filters", [[1.0], [["a"]], [[[1.0]]], 3, [[True]], [[10**400]], "ab"])
def test_records_with_other_things_for_bands_are_refused(filters):
    with pytest.raises(jm.JaxmarkError, match="takes the parameters filters, hiding"):
        make_scheme("own-bands", {"filters": filters, "hiding": True})
    with pytest.raises(jm.JaxmarkError, match="takes the parameters"):
        make_scheme("keyed", {"profile": [[1.0]]})
    for bands, strengths in ((np.ones(3), None), (np.ones((2, 3)), np.ones(3))):
        with pytest.raises(jm.JaxmarkError, match="Own bands are an array"):
            OwnBandsScheme.from_arrays(bands, strengths)
    for bands, strengths in (("abc", None), ([[1j]], None), ([[1.0]], ["a"]), ([[1.0], [1.0, 2.0]], None)):
        with pytest.raises(jm.JaxmarkError, match="arrays of real numbers"):
            OwnBandsScheme.from_arrays(bands, strengths)  # pyright: ignore


def changed(filters: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "exchanged": filters[[1, 0, *range(2, len(filters))]],
        "one flipped": filters * np.where(np.arange(len(filters)) == 0, -1, 1)[:, None],
        "all flipped": -filters,
        "scaled": 2 * filters,
        "split": np.vstack([filters[:1] / 2**0.5, filters[:1] / 2**0.5, filters[1:]]),
    }


@pytest.mark.parametrize("change", list(changed(BANDS)))
def test_a_key_holder_who_edits_bands_of_equal_effect_reads_nothing(mesh: Mesh, key: jm.Key, change: str):
    """The signs are others, even where the bands pass the same energy; the claim of the message is no way around."""
    own = OwnBandsScheme.from_arrays(BANDS)
    marker = jm.make_marker(mesh, key, bits=16, scheme=own)
    marked, info = marker.embed(b"ok", jm.Budget(rms=2e-3, noise=0), read_back="never")
    parameters = parameters_of(OwnBandsScheme.from_arrays(changed(np.asarray(BANDS))[change]))
    edited = dataclasses.replace(info.record, parameters=parameters, message_commitment="").sealed(key)
    other = jm.make_marker(mesh, key, record=edited)
    for claim in (None, b"ok"):
        assert other.detect(marked, claim).log10_p > -3
    assert marker.detect(marked).message == b"ok"


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e5])
def test_a_common_factor_of_the_bands_changes_nothing(mesh: Mesh, key: jm.Key, size: float):
    own = OwnBandsScheme.from_arrays(size * np.asarray(BANDS) / np.abs(BANDS).max())
    marker = jm.make_marker(mesh, key, bits=16, scheme=own)
    marked, info = marker.embed(b"ok", jm.Budget(rms=2e-3))
    assert info.rms == pytest.approx(2e-3, rel=0.01)
    assert marker.detect(marked).log10_p < -70


@pytest.mark.parametrize(
    "scheme", [OwnBandsScheme(((0, 1, 0), (1, 0, -1))), KeyedScheme(profile=(0, *(1,) * 20))], ids=["own", "keyed"]
)
def test_whole_numbers_in_a_scheme_are_read_back_from_its_record(mesh: Mesh, key: jm.Key, scheme, tmp_path):
    marker = jm.make_marker(mesh, key, bits=0, scheme=scheme)
    marked, info = marker.embed(b"", 2e-3, read_back="never")
    (tmp_path / "record.json").write_text(info.record.to_json())
    record = jm.Record.load(tmp_path / "record.json")
    assert jm.detect(marked, original=mesh, key=key, record=record).detected()
