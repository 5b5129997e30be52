"""How many bits a mesh carries: against published values, dense matrices, and what is refused and read."""

import itertools
import math
import re

import numpy as np
import pytest
from scipy import integrate, optimize

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.geometry.mesh import Mesh, make_mesh, vertex_normals
from jaxmark.spectral.bands import scaling
from jaxmark.watermark.coding.keys import Choices
from jaxmark.watermark.perception.budget import Bounds
from jaxmark.watermark.perception.capacity import (
    Capacity,
    Conditions,
    least_energy,
    needed_dimensions,
    needed_energy,
    worth,
)
from jaxmark.watermark.reading.reception import make_receiver
from jaxmark.watermark.schemes.keyed import KeyedScheme
from tests.dense import chebyshev_matrices
from tests.samples import bumpy_sphere, rough_sphere

USUAL = Conditions(Bounds(8e-4, {}), noise=0.005, coverage=0.5)


@pytest.fixture(scope="module")
def thousand() -> Mesh:
    """1,100 vertices."""
    return rough_sphere(1100)


@pytest.fixture(scope="module")
def known(thousand: Mesh) -> Capacity:
    """Of 1,100 vertices; it remembers what it measured."""
    return Capacity(make_original(thousand), KeyedScheme())


@pytest.fixture(scope="module")
def coarse(thousand: Mesh) -> Capacity:
    """With wider bands, and so fewer layouts to measure."""
    return Capacity(make_original(thousand), KeyedScheme(bands=16))


def decibel(value: float) -> float:
    return 10 * math.log10(value)


@pytest.mark.parametrize(("bits", "error"), [(1, 1e-3), (8, 1e-3), (64, 1e-3), (100, 1e-6), (256, 1e-3), (900, 1e-2)])
def test_least_energy_is_the_converse(bits, error):
    """2^-k = Q(√(2E/N0) + Q⁻¹(1 - ε)), with Q as the integral that it is."""
    energy = least_energy(bits, error)
    shift = optimize.brentq(lambda x: gaussian_tail(x) - (1 - error), -10, 10)
    argument = math.sqrt(2 * energy) + shift
    # The logarithm of the tail, the largest factor taken out of the integral.
    scaled = integrate.quad(lambda t: math.exp(-argument * t - t * t / 2), 0, 20, epsabs=0, epsrel=1e-10)[0]
    logarithm = math.log(scaled) - argument**2 / 2 - math.log(2 * math.pi) / 2
    assert logarithm == pytest.approx(-bits * math.log(2), rel=1e-7)


def gaussian_tail(x: float) -> float:
    return integrate.quad(lambda t: math.exp(-t * t / 2) / math.sqrt(2 * math.pi), x, x + 40, points=[0.0], limit=200)[
        0
    ]


def test_least_energy_falls_to_shannons():
    assert decibel(least_energy(64) / 64) == pytest.approx(0.634, abs=1e-3)
    sizes = [1, 8, 64, 1000, 10**5, 10**6]
    each = [least_energy(bits) / bits for bits in sizes]
    assert all(after < before for before, after in itertools.pairwise(each))
    assert each[-1] > math.log(2)
    assert decibel(each[-1]) == pytest.approx(decibel(math.log(2)), abs=0.03)
    assert decibel(math.log(2)) == pytest.approx(-1.59, abs=5e-3)
    assert least_energy(64, 1e-6) > least_energy(64, 1e-3) > least_energy(64, 1e-1)


def test_needed_energy_is_more_than_the_least():
    for bits in (8, 64, 256):
        assert 0 < decibel(needed_energy(bits) / least_energy(bits + 28)) < 3  # 28 bits of tag


def test_bits_are_noise_to_each_other():
    """In n dimensions no energy is worth more than n; little energy is worth what it is."""
    dimensions = np.array([100.0, 300.0, 0.0])
    assert worth(np.full(3, 1e9), dimensions) == pytest.approx(400, rel=1e-6)
    assert worth(np.full(3, 1e-6), dimensions) == pytest.approx(400e-6, rel=1e-5)
    # E/N0 of 10 in 400 dimensions to each bit: the others' energy adds to the noise's, N0/2 in each dimension.
    assert worth(np.full(3, 10 / 400), dimensions) == pytest.approx(10 / (1 + 10 / 400), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["coordinates", "normals"])
@pytest.mark.parametrize("passband", ["tapered", "narrow"])
def test_room_is_what_the_projection_leaves(direction, passband, x64):
    """By dense matrices: of white displacements in each band, and the energy of a mark of unit mean square."""
    original, scheme = make_original(bumpy_sphere(2)), KeyedScheme(32, direction, passband=passband, hiding=False)
    carrier = scheme.carrier(original, Choices(jm.Key(bytes(32)), b""), 8, 32)
    passing = scheme.layout(original, 8).passing
    count = len(original.used)
    terms = chebyshev_matrices(original.operator, 31)[:, :count, :count]
    degree = original.to_host(original.operator.degree)
    mass = degree / np.mean(degree)
    filters = mass[:, None] * np.einsum("jk,kuv->juv", scaling(32, damping="jackson")[:passing], terms)
    columns = np.kron(original.to_host(make_receiver(carrier.host).nuisance), np.eye(3))
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    white = np.eye(3 * len(terms[0]))
    if direction == "normals":
        normals = vertex_normals(original.mesh)
        white = np.einsum("vc,vu->vcu", normals, np.eye(len(normals))).reshape(-1, len(normals))
    left = white - basis @ (basis.T @ white)
    strengths = np.asarray(carrier.profile)
    found = carrier.reader().free_dimensions(original.to_traced(original.used))
    energy = 0.0
    for band, filter in enumerate(filters):
        # One probe of random signs: its variance is twice the energy off the diagonal.
        products = left.T @ np.kron(filter, np.eye(3)) @ left
        off = np.sum(products**2) - np.sum(np.diag(products) ** 2)
        expected = np.trace(products) * (strengths[band] > 0)
        assert found.dimensions[band] == pytest.approx(expected, abs=4 * np.sqrt(2 * off) + 1e-9)
        energy += strengths[band] ** 2 * np.trace(white.T @ np.kron(filter, np.eye(3)) @ white)
    np.testing.assert_allclose(found.energy, strengths**2 * len(terms[0]) / energy, rtol=0.1, atol=1e-12)
    assert 0.2 < found.dimensions @ found.energy / len(terms[0]) < 0.97


def test_least_budget_by_its_definition(known: Capacity, thousand: Mesh):
    """Energy over noise, with the energy of the vertices that are left and uniform noise of variance ν²/3."""
    original, scheme = make_original(thousand), KeyedScheme()
    carrier = scheme.carrier(original, Choices(jm.Key(b"k" * 32), b""), 16, scheme.code_length(original, 16))
    left = carrier.reader().free_dimensions(original.to_traced(original.used))
    points = thousand.vertices - thousand.vertices.mean(axis=0)
    width = 0.005 * np.linalg.norm(points, axis=1).mean() / np.linalg.norm(np.ptp(thousand.vertices, axis=0))
    budget = known.least_budget(16, USUAL)
    # The budget is the root mean square length of the displacements, N0/2 the noise's variance in one dimension.
    ratio = left.energy * budget**2 / (2 * width**2 / 3)
    assert worth(ratio, 0.5 * left.dimensions) == pytest.approx(needed_energy(16), rel=1e-6)


def test_least_budget_scales(known: Capacity):
    least = known.least_budget(16, USUAL)
    assert known.least_budget(16, USUAL._replace(noise=0.015)) == pytest.approx(3 * least, rel=1e-9)
    assert known.least_budget(16, USUAL._replace(noise=0.0)) == 0
    assert known.least_budget(16, USUAL._replace(bounds=Bounds(1e-9, {}))) == least
    # As 1/√coverage, but for the interference of the bits, which a smaller coverage raises.
    whole = known.least_budget(16, USUAL._replace(coverage=1.0))
    assert 1.05 * math.sqrt(2) < least / whole < 2
    assert known.least_budget(16, USUAL._replace(coverage=0.01)) == math.inf
    scheme, original = KeyedScheme(), known.original
    dimensions = known._free[scheme.layout(original, 16)].dimensions.sum()
    assert 0.99 * needed_dimensions(16) / dimensions > 0.01  # and so it must be
    assert known.least_budget(10**5, USUAL) == math.inf


@pytest.mark.slow
def test_bits_are_monotone(coarse: Capacity):
    rising = {
        "budget": [coarse.bits(USUAL._replace(bounds=Bounds(rms, {}))) for rms in (1e-4, 4e-4, 8e-4, 1.2e-3, 1.6e-3)],
        "noise": [coarse.bits(USUAL._replace(noise=n)) for n in (0.1, 0.01, 0.005, 0.003, 0.002)],
        "coverage": [coarse.bits(USUAL._replace(coverage=c)) for c in (0.05, 0.3, 0.5, 0.7, 1.0)],
    }
    for sizes in rising.values():
        assert sizes == sorted(sizes)
        assert sizes[0] == 0
        assert sizes[-1] > sizes[2] > 0
        assert all(size % 8 == 0 for size in sizes)


@pytest.mark.slow
@pytest.mark.parametrize("budget", [8e-4, 1.16e-3, 1.5e-3])
def test_bits_is_the_largest_payload(budget, coarse: Capacity):
    """No larger one fits, and every smaller one does."""
    conditions = USUAL._replace(bounds=Bounds(budget, {}))
    most = coarse.bits(conditions)
    assert most > 0
    for bits in range(8, 400, 8):
        assert (coarse.least_budget(bits, conditions) <= budget) == (bits <= most)


def test_what_carries_a_payload_carries_a_shorter_one():
    small = Capacity(make_original(bumpy_sphere(3)), KeyedScheme())
    assert small.least_budget(8, USUAL) <= small.least_budget(64, USUAL) < math.inf


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vertices", "bits", "budget"),
    [(2562, 64, 8e-4), (1100, 16, 8e-4), (10242, 256, 8e-4), (10242, 64, 2e-4)],
)
def test_payloads_that_must_not_be_refused(vertices, bits, budget, known: Capacity):
    """They read with half of the vertices lost under the strongest noise of the protocol.

    The free dimensions are measured with one probe, which may be off by a percent. That some points move more takes
    another percent.
    """
    budget *= 1.02
    if vertices == 1100:
        assert known.least_budget(bits, USUAL) <= budget
        return
    mesh = bumpy_sphere({2562: 4, 10242: 5}[vertices])
    assert len(mesh.vertices) == vertices
    assert Capacity(make_original(mesh), KeyedScheme()).least_budget(bits, USUAL) <= budget


@pytest.mark.slow
def test_what_is_stated_is_kept(thousand: Mesh, known: Capacity, key: jm.Key):
    """A refusal names a payload and a budget, and both are accepted as they stand."""
    most = jm.capacity(thousand, 8e-4)
    assert most == known.bits(USUAL)
    noise = USUAL.noise
    jm.embed(thousand, bytes(most // 8), key, budget=jm.Budget(rms=8e-4, noise=noise))
    larger = bytes(most // 8 + 1)
    with pytest.raises(jm.JaxmarkError) as refusal:
        jm.embed(thousand, larger, key, budget=jm.Budget(rms=8e-4, noise=noise))
    said = r"at most (\d+) bits .*the payload is (\d+) bits\. .*at least ([0-9.e-]+\d)\.$"
    stated = re.search(said, str(refusal.value))
    assert stated is not None
    assert int(stated[1]) == most
    assert int(stated[2]) == most + 8
    least = known.least_budget(most + 8, USUAL)
    assert float(stated[3]) == pytest.approx(least, rel=0.05)
    jm.embed(thousand, larger, key, budget=jm.Budget(rms=float(stated[3]), noise=noise))
    with pytest.raises(jm.JaxmarkError, match="carries at most"):
        jm.embed(thousand, larger, key, budget=jm.Budget(rms=0.99 * least, noise=noise))
    # Where nothing but the noise asked for is too much, less of it is accepted.
    jm.embed(thousand, larger, key, budget=jm.Budget(rms=8e-4, noise=0.99 * 0.005 * 8e-4 / least))
    with pytest.raises(jm.JaxmarkError, match=r"carries at most \d+ bits .* Use a shorter message\.$"):
        jm.embed(thousand, bytes(110), key, budget=jm.Budget(rms=8e-4, noise=noise))


@pytest.mark.parametrize("bits", [16, 24, 48])
def test_a_stated_least_budget_is_never_below_the_least(bits, thousand: Mesh, known: Capacity, key: jm.Key):
    """What a refusal names is rounded, but upwards."""
    marker = jm.make_marker(thousand, key, bits=bits)
    with pytest.raises(jm.JaxmarkError) as refusal:
        marker.embed(bytes(bits // 8), jm.Budget(rms=1e-5, noise=USUAL.noise))
    stated = float(re.search(r"at least ([0-9.e-]+\d)\.$", str(refusal.value))[1])
    least = known.least_budget(bits, USUAL)
    assert least <= stated < 1.001 * least


@pytest.mark.slow
def test_a_message_at_capacity_reads_after_the_noise_it_is_stated_for(thousand: Mesh, key: jm.Key):
    """With half of the vertices unknown."""
    bits = jm.capacity(thousand, 8e-4)
    marker = jm.make_marker(thousand, key, bits=bits)
    radius = np.linalg.norm(thousand.vertices - thousand.vertices.mean(axis=0), axis=1).mean()
    for seed in range(5):
        random = np.random.default_rng(seed)
        message = random.bytes(bits // 8)
        marked, _ = marker.embed(message, 8e-4)
        noisy = marked.vertices + 0.005 * radius * random.uniform(-1, 1, marked.vertices.shape)
        known = random.permutation(len(noisy)) < len(noisy) // 2
        found = marker.detect(make_mesh(noisy, thousand.faces), weights=known.astype(float))
        assert found.message == message
        assert found.detected(allow_estimate=True)  # weights that a reader chooses make it an estimate
        assert found.coverage == 0.5


@pytest.mark.usefixtures("unchecked")
def test_numbers_out_of_range_are_refused():
    mesh = bumpy_sphere(1)
    for change in (
        {"budget": 0.0},
        {"budget": 1.0},
        {"budget": -1e-3},
        {"budget": math.nan},
        {"coverage": 0.0},
        {"coverage": 1.01},
        {"coverage": math.nan},
    ):
        with pytest.raises(jm.JaxmarkError, match=r"budget is relative|capacity needs"):
            jm.capacity(mesh, **change)
    for noise in (-1e-9, math.inf, math.nan):
        with pytest.raises(jm.JaxmarkError, match="noise to survive is a number of at least 0"):
            jm.Budget(noise=noise)
    nowhere = mesh._replace(vertices=np.where(mesh.vertices > 0.5, np.nan, mesh.vertices))
    with pytest.raises(jm.JaxmarkError, match="not a finite number"):
        jm.capacity(nowhere)
