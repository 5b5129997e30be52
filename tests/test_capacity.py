"""How many bits a mesh carries: against published values, dense matrices, and what is refused and read."""

import itertools
import math
import re

import numpy as np
import pytest
from scipy import integrate, optimize

import jaxmark as jm
from jaxmark.bands import scaling
from jaxmark.budget import make_budget
from jaxmark.mesh import Mesh, make_mesh, vertex_normals
from jaxmark.original import prepare
from jaxmark.payload import Capacity, Conditions, least_energy, needed_dimensions, needed_energy, room
from jaxmark.schemes import KeyedScheme
from tests.dense import chebyshev_matrices
from tests.samples import bumpy_sphere, rough_sphere

USUAL = Conditions(make_budget(8e-4), noise=0.005, coverage=0.5)


@pytest.fixture(scope="module")
def thousand() -> Mesh:
    """1,100 vertices."""
    return rough_sphere(1100)


@pytest.fixture(scope="module")
def known(thousand: Mesh) -> Capacity:
    """Of 1,100 vertices; it remembers what it measured."""
    return Capacity(prepare(thousand), KeyedScheme())


@pytest.fixture(scope="module")
def coarse(thousand: Mesh) -> Capacity:
    """With wider bands, and so fewer layouts to measure."""
    return Capacity(prepare(thousand), KeyedScheme(bands=16))


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
        apart = needed_energy(bits, 1e9)
        assert 0 < decibel(apart / least_energy(bits + 28)) < 3  # 28 bits of tag
        assert needed_energy(bits, 10 * apart) > needed_energy(bits, 100 * apart) > apart
        assert needed_energy(bits, 0.9 * apart) == math.inf


@pytest.mark.parametrize("direction", ["coordinates", "normals"])
def test_room_is_what_the_projection_leaves(direction, x64):
    """By dense matrices: tr T over the mark's energy and (tr T)²/tr T², T from chips to what is left of them."""
    original, scheme = prepare(bumpy_sphere(2)), KeyedScheme(bands=32, direction=direction)
    carrier = scheme.carrier(original, bytes(32), 8, 32)
    passing = scheme.layout(original, 8).passing
    terms = chebyshev_matrices(original.operator, 31)
    filter = np.einsum("jk,kuv->uv", scaling(32, damping="jackson")[:passing], terms)
    nuisance = np.asarray(carrier.host.nuisance)
    if direction == "coordinates":
        written = np.kron(filter, np.eye(3))
    else:
        normals = vertex_normals(original.mesh)
        written = (normals[:, :, None] * filter[:, None, :]).reshape(3 * len(filter), len(filter))
    columns = np.kron(nuisance, np.eye(3))
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    left = written - basis @ (basis.T @ written)
    products = left.T @ left
    energy, spread = np.trace(products), np.sum(products**2)
    found = room(carrier, original)
    # One probe of random signs: its variance is twice the energy off the diagonal.
    off = np.sum(products**2) - np.sum(np.diag(products) ** 2)
    fourth = products @ products
    deviation = np.hypot(
        2 * np.sqrt(2 * off) / energy, np.sqrt(2 * (np.sum(fourth**2) - np.sum(np.diag(fourth) ** 2))) / spread
    )
    assert found.dimensions == pytest.approx(energy**2 / spread, rel=4 * deviation)
    assert found.energy == pytest.approx(energy / np.sum(written**2), abs=0.05)
    assert 0.3 < found.energy < 0.97


def test_least_budget_by_its_definition(known: Capacity, thousand: Mesh):
    """Energy over noise, with the energy of the vertices that are left and uniform noise of variance ν²/3."""
    original, scheme = prepare(thousand), KeyedScheme()
    left = room(scheme.carrier(original, b"k" * 32, 16, scheme.code_length(original, 16)), original)
    points = thousand.vertices - thousand.vertices.mean(axis=0)
    width = 0.005 * np.linalg.norm(points, axis=1).mean() / np.linalg.norm(np.ptp(thousand.vertices, axis=0))
    budget = known.least_budget(16, USUAL)
    # The budget is the root mean square length of the displacements, N0/2 the noise's variance in one dimension.
    energy = 1100 * 0.5 * left.energy * budget**2 / (2 * width**2 / 3)
    assert energy == pytest.approx(needed_energy(16, 0.5 * left.dimensions), rel=1e-3)


def test_least_budget_scales(known: Capacity):
    least = known.least_budget(16, USUAL)
    assert known.least_budget(16, USUAL._replace(noise=0.015)) == pytest.approx(3 * least, rel=1e-12)
    assert known.least_budget(16, USUAL._replace(noise=0.0)) == 0
    assert known.least_budget(16, USUAL._replace(budget=make_budget(1e-9))) == least
    # As 1/√coverage, but for the interference of the bits, which a smaller coverage raises.
    whole = known.least_budget(16, USUAL._replace(coverage=1.0))
    scheme, original = KeyedScheme(), known._original
    dimensions = known._rooms[scheme.layout(original, 16)].dimensions
    crowding = needed_energy(16, 0.5 * dimensions) / needed_energy(16, dimensions)
    assert crowding > 1
    assert least / whole == pytest.approx(math.sqrt(2 * crowding), rel=1e-12)
    assert known.least_budget(16, USUAL._replace(coverage=0.01)) == math.inf
    assert 0.99 * needed_dimensions(16) / dimensions > 0.01  # and so it must be
    assert known.least_budget(10**5, USUAL) == math.inf


@pytest.mark.slow
def test_bits_are_monotone(coarse: Capacity):
    rising = {
        "budget": [coarse.bits(USUAL._replace(budget=make_budget(b))) for b in (1e-4, 4e-4, 8e-4, 1.2e-3, 1.6e-3)],
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
    conditions = USUAL._replace(budget=make_budget(budget))
    most = coarse.bits(conditions)
    assert most > 0
    for bits in range(8, 400, 8):
        assert (coarse.least_budget(bits, conditions) <= budget) == (bits <= most)


def test_what_carries_a_payload_carries_a_shorter_one():
    small = Capacity(prepare(bumpy_sphere(3)), KeyedScheme())
    assert small.least_budget(8, USUAL) <= small.least_budget(64, USUAL) < math.inf


@pytest.mark.parametrize(
    ("vertices", "bits", "budget"),
    [(2562, 64, 8e-4), (1100, 16, 8e-4), (10242, 256, 8e-4), (10242, 64, 2e-4)],
)
def test_payloads_that_must_not_be_refused(vertices, bits, budget, known: Capacity):
    """They read with half of the vertices lost under the strongest noise of the protocol."""
    if vertices == 1100:
        assert known.least_budget(bits, USUAL) <= budget
        return
    mesh = bumpy_sphere({2562: 4, 10242: 5}[vertices])
    assert len(mesh.vertices) == vertices
    assert Capacity(prepare(mesh), KeyedScheme()).least_budget(bits, USUAL) <= budget


@pytest.mark.slow
def test_what_is_stated_is_kept(thousand: Mesh, known: Capacity, key: jm.Key):
    """A refusal names a payload and a budget, and both are accepted as they stand."""
    most = jm.capacity(thousand, 8e-4)
    assert most == known.bits(USUAL)
    jm.embed(thousand, bytes(most // 8), key, budget=8e-4)
    larger = bytes(most // 8 + 1)
    with pytest.raises(jm.JaxmarkError) as refusal:
        jm.embed(thousand, larger, key, budget=8e-4)
    stated = re.search(r"at most (\d+) bits .* not (\d+)\. .*at least ([0-9.e-]+\d)\.$", str(refusal.value))
    assert stated is not None
    assert int(stated[1]) == most
    assert int(stated[2]) == most + 8
    least = known.least_budget(most + 8, USUAL)
    assert float(stated[3]) == pytest.approx(least, rel=0.05)
    jm.embed(thousand, larger, key, budget=float(stated[3]))
    with pytest.raises(jm.JaxmarkError, match="carries at most"):
        jm.embed(thousand, larger, key, budget=0.99 * least)
    # Where nothing but the noise asked for is too much, less of it is accepted.
    jm.embed(thousand, larger, key, budget=8e-4, noise=0.99 * 0.005 * 8e-4 / least)
    with pytest.raises(jm.JaxmarkError, match=r"Use a shorter message\.$"):
        jm.embed(thousand, bytes(110), key, budget=8e-4)


@pytest.mark.parametrize("bits", [16, 24, 48])
def test_a_stated_least_budget_is_never_below_the_least(bits, thousand: Mesh, known: Capacity, key: jm.Key):
    """What a refusal names is rounded, but upwards."""
    marker = jm.make_marker(thousand, key, bits=bits)
    with pytest.raises(jm.JaxmarkError) as refusal:
        marker.embed(bytes(bits // 8), 1e-5)
    stated = float(re.search(r"at least ([0-9.e-]+\d)\.$", str(refusal.value))[1])
    least = known.least_budget(bits, USUAL)
    assert least <= stated < 1.1 * least


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
        assert found.detected()
        assert found.coverage == 0.5


@pytest.mark.usefixtures("unchecked")
def test_numbers_out_of_range_are_refused():
    mesh = bumpy_sphere(1)
    for change in (
        {"budget": 0.0},
        {"budget": 1.0},
        {"budget": -1e-3},
        {"budget": math.nan},
        {"noise": -1e-9},
        {"noise": math.inf},
        {"noise": math.nan},
        {"coverage": 0.0},
        {"coverage": 1.01},
        {"coverage": math.nan},
    ):
        with pytest.raises(jm.JaxmarkError, match=r"budget is relative|capacity needs"):
            jm.capacity(mesh, **change)
    nowhere = mesh._replace(vertices=np.where(mesh.vertices > 0.5, np.nan, mesh.vertices))
    with pytest.raises(jm.JaxmarkError, match="not a finite number"):
        jm.capacity(nowhere)
