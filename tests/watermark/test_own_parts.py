"""A carrier and a scheme of one's own take part in everything that the library's own do."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.adversaries import erasure, erasure_by_descent
from jaxmark.adversaries.expected import evidence, make_surrogate
from jaxmark.alignment.observation import Observation, observe
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh, vertex_normals
from jaxmark.spectral.laplacian import per_row
from jaxmark.spectral.precision import matmul, sum_and_norm
from jaxmark.watermark.bits import detect_bits, log_evidence
from jaxmark.watermark.blind.local import LocalScheme
from jaxmark.watermark.blind.reading import _caveats
from jaxmark.watermark.carriers import Carrier, Claim, PlainReader, Reader, make_spread_carrier
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.coding.message import code_length
from jaxmark.watermark.interfaces import Detector, Scheme
from jaxmark.watermark.markers import make_blind_marker
from jaxmark.watermark.reading.detectors import claims, correlate
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.samples import bumpy_sphere, rough_sphere

pytestmark = pytest.mark.core

MESSAGE, BITS = b"o", 8


class Patches(NamedTuple):
    """Every bit has patches of its own, smoothed, which move along x by keyed signs."""

    patches: jax.Array  # vertices, bits, patches of a bit
    degree: jax.Array
    signs: jax.Array  # bits, patches of a bit

    @property
    def code_bits(self) -> int:
        return self.patches.shape[1]

    @property
    def detector(self) -> Detector:
        return correlate

    def displacement(self, bits, beta=1.0):
        heights = matmul(self.patches.reshape(len(self.degree), -1), (bits[:, None] * self.signs).ravel())
        return jnp.asarray(beta) * heights[:, None] * jnp.eye(3, dtype=heights.dtype)[:1]

    def adjoint(self, residual, beta=1.0):
        found = matmul(self.patches.reshape(len(self.degree), -1).T, (per_row(self.degree, residual) * residual)[:, 0])
        return jnp.asarray(beta) * jnp.sum(self.signs * found.reshape(self.signs.shape), axis=1)

    def gram(self, beta=1.0):
        return jax.vmap(lambda bits: self.adjoint(self.displacement(bits, beta), beta))(jnp.eye(self.code_bits))

    def claim(self, seen: Observation, bits) -> Claim:
        shown = seen.weigh(seen.residual)[:, 0]
        found = matmul(self.patches.reshape(len(self.degree), -1).T, shown).reshape(self.signs.shape)
        return Claim(*sum_and_norm(bits[:, None] * self.signs * found))

    def redraw(self, key):
        return self._replace(signs=jax.random.rademacher(key, self.signs.shape, self.signs.dtype))

    def reader(self) -> PlainReader:
        return PlainReader(self)


@dataclass(frozen=True)
class PatchScheme(Scheme):
    """Patches around vertices drawn at random, the same for every key."""

    name: ClassVar[str] = "patches"
    size: int = 8  # patches of a bit

    def code_length(self, original: Original, bits: int) -> int:
        return code_length(bits, len(original.used) // self.size, 2)

    def carrier(self, original: Original, choices: Choices, bits: int, code_bits: int) -> Any:
        rows = len(original.signal)
        centres = np.random.default_rng(0).permutation(len(original.used))[: self.size * code_bits]
        patches = jnp.zeros((rows, len(centres)), original.signal.dtype).at[centres, np.arange(len(centres))].set(1)
        for _ in range(2):
            patches -= 0.5 * original.operator.apply(patches)
        keyed = choices.signs(f"{self.name}/{code_bits}", len(centres)).reshape(code_bits, self.size)
        return Patches(
            patches.reshape(rows, code_bits, self.size),
            jnp.asarray(original.operator.degree, original.signal.dtype),
            jnp.asarray(keyed, original.signal.dtype),
        )


@pytest.fixture(scope="module")
def marked(key: jm.Key) -> tuple[jm.watermark.NonBlindMarker, Mesh]:
    marker = jm.make_marker(bumpy_sphere(3), key, bits=BITS, scheme=PatchScheme())
    return marker, marker.embed(MESSAGE, 2e-3)[0]


def lifted(operator, normals, chips):
    return normals * (chips - 0.5 * operator.apply(chips))


def test_a_linear_map_makes_a_carrier(key: jm.Key, x64):
    """Its adjoint and its claim against dense matrices; its mark is read, and redrawn signs have no evidence."""
    original = jm.alignment.make_original(bumpy_sphere(2))
    normals = original.to_traced(vertex_normals(bumpy_sphere(2)))
    shape = jax.tree_util.Partial(lifted, original.operator, normals)
    carrier = make_spread_carrier(original, Choices(key, b""), 40, shape, channels=1)
    assert isinstance(carrier, Carrier)
    columns = jax.vmap(carrier.displacement, out_axes=-1)(jnp.eye(40))
    random = np.random.default_rng(0)
    residual, bits = jnp.asarray(random.normal(size=columns.shape[:2])), jnp.asarray(random.choice([-1.0, 1], 40))
    products = jnp.einsum("vck,vc->k", columns, residual)
    np.testing.assert_allclose(carrier.adjoint(residual, 2.0), 2 * products, atol=1e-12)
    np.testing.assert_allclose(carrier.gram(), jnp.einsum("vci,vcj->ij", columns, columns), atol=1e-12)
    found = carrier.claim(observe(residual), bits)
    assert float(found.score) == pytest.approx(float(bits @ products), rel=1e-6)
    chips = jax.vmap(shape, out_axes=-1)(jnp.eye(len(original.signal))[:, :, None])
    a = jnp.where(original.moving, jnp.einsum("vcj,vc->j", chips, residual), 0)
    assert float(found.norm) == pytest.approx(float(jnp.linalg.norm(a)), rel=1e-6)
    soft = detect_bits(carrier.displacement(bits, 1e-3), 0 * residual, carrier)
    np.testing.assert_array_equal(jnp.sign(soft), bits)
    other = carrier.redraw(0)
    assert float(log_evidence(carrier.displacement(bits), 0 * residual, carrier, bits)) > 10
    assert float(log_evidence(carrier.displacement(bits), 0 * residual, other, bits)) < 5


def owner_sees(marker: jm.watermark.NonBlindMarker, suspect: Mesh) -> float:
    """S/‖a‖ of the claim of the message."""
    codeword = jnp.asarray(marker.codeword(MESSAGE), jnp.float32)
    score, norm = claims(marker.reader, marker.receive(marker.register(suspect)), codeword)
    return float(score[0] / norm[0])


def test_it_marks_and_reads(marked, key: jm.Key):
    marker, mesh = marked
    assert isinstance(marker.carrier, Carrier)
    assert isinstance(marker.reader, Reader)
    found = marker.detect(jm.attack(mesh, "noise", 5e-4, seed=0))
    assert found.message == MESSAGE
    assert found.log10_p < -4
    assert marker.detect(marker.original.mesh).log10_p == 0


def test_subclasses_of_schemes_prove_nothing(marked, key: jm.Key):
    class Keyed(KeyedScheme):
        """May do anything."""

    class Local(LocalScheme):
        """May do anything."""

    _, mesh = marked
    assert not jm.make_marker(mesh, key, bits=BITS).caveats
    assert "not one of this library" in jm.make_marker(mesh, key, bits=BITS, scheme=Keyed()).caveats[0]
    own = _caveats(Local(), None)
    assert own == ("the scheme 'local' is not one of this library",)
    assert not _caveats(LocalScheme(), None)


def test_widths_and_steps_of_ones_own_prove_nothing_without_a_record():
    usual = LocalScheme()
    other = dataclasses.replace(usual, steps=(1.01 * usual.steps[0],))
    assert "chosen by the reader" in _caveats(other, None)[0]
    assert not _caveats(dataclasses.replace(usual, steps=usual.steps[:1]), None), "which is charged for all"


@pytest.mark.slow
def test_a_presence_mark_of_ones_own_blind_scheme_reads_back(key: jm.Key):
    class Local(LocalScheme):
        """May do anything."""

    marker = make_blind_marker(rough_sphere(2500, 0), key, bits=0, scheme=Local())
    marked, _ = marker.embed(b"", jm.Budget(rms=4e-3, noise=0))
    assert marker.detect(marked).evidence.caveats
    assert marker.reads(marked, b"")


def test_its_capacity_is_what_it_has_code_bits_for():
    mesh = bumpy_sphere(3)
    most = jm.capacity(mesh, 1e-3, scheme=PatchScheme())
    assert PatchScheme().code_length(jm.alignment.make_original(mesh), most) == 64
    with pytest.raises(jm.JaxmarkError, match="do not fit"):
        jm.make_marker(mesh, jm.new_key(), bits=most + 8, scheme=PatchScheme())


@pytest.mark.slow
def test_enemies_attack_it(marked):
    marker, mesh = marked
    before = owner_sees(marker, mesh)
    surrogate, _ = make_surrogate(mesh, PatchScheme(), BITS, 2e-3)
    still = jnp.zeros_like(surrogate.signal)
    expected = [float(evidence(surrogate, still, jax.random.key(seed))) for seed in range(4)]
    assert np.mean(expected) == pytest.approx(before, rel=0.1)
    for attack in (erasure(marker, MESSAGE), erasure_by_descent(marker, MESSAGE, steps=2)):
        assert owner_sees(marker, jm.attack(mesh, attack, 2.5e-3, seed=0)) < 0.5 * before


def test_studies_and_curves_read_it(marked, tmp_path):
    marker, mesh = marked
    assert jm.robustness(marker, mesh, MESSAGE, "noise", [2e-4], samples=1).success.all()
    study = jm.Study(
        meshes={"ball": bumpy_sphere(3)}, attacks={"noise": [2e-4]}, budgets=[2e-3], payloads=[BITS],
        schemes={"patches": PatchScheme()}, samples=1,
    )  # fmt: skip
    rows = study.run(tmp_path / "rows.jsonl").rows
    assert [row.read for row in rows if row.control == "marked"] == [True]
    assert not any(row.read for row in rows if row.control != "marked")


def test_tuning_says_that_it_has_no_bands():
    with pytest.raises(jm.JaxmarkError, match="'patches' has no bands whose strengths could be tuned"):
        jm.tune(bumpy_sphere(2), [("noise", 1e-3)], 1e-3, seed=0, scheme=PatchScheme())


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (lambda chips: chips + 1, "must be a linear function"),
        (jnp.abs, "must be a linear function"),
        (lambda chips: chips**2, "must be a linear function"),
        (lambda chips: chips[:5], r"one for each row.* this one returns \(5, 3\)"),
    ],
)
def test_maps_that_are_not_linear_make_no_carrier(sphere: Mesh, key: jm.Key, function, sentence: str):
    original, choices = jm.alignment.make_original(sphere), Choices(key, b"")
    with pytest.raises(jm.JaxmarkError, match=sentence):
        make_spread_carrier(original, choices, 16, jax.tree_util.Partial(function))
    for bits, channels in ((0, 3), (16, 0)):
        with pytest.raises(jm.JaxmarkError, match=f"code bits and channels, got {bits} and {channels}"):
            make_spread_carrier(original, choices, bits, jax.tree_util.Partial(lambda chips: chips), channels=channels)
