"""Fixtures that many tests share; dtypes are never promoted silently."""

import gc
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxtyping
import numpy as np
import pytest

import jaxmark as jm
from jaxmark.geometry.mesh import Mesh, make_mesh
from tests.samples import bumpy_sphere

# One cache of compiled programs for all workers, commands that tests start, and later runs in this environment.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(sys.prefix) / ".programs"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update(
    "jax_persistent_cache_min_compile_time_secs", float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
)

MOST_KIBIBYTES = 3 * 2**20  # of a process, up to which it keeps its programs


def pytest_collection_finish() -> None:
    """Look for garbage more rarely: tracing makes many objects, few of which are garbage."""
    gc.set_threshold(200_000, 20, 20)


@pytest.fixture(autouse=True)
def _strict_promotion() -> Iterator[None]:
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(autouse=True)
def _processors_only(request: pytest.FixtureRequest) -> None:
    if request.node.get_closest_marker("processor") and jax.default_backend() != "cpu":
        pytest.skip("for processors only")


@pytest.fixture(scope="module", autouse=True)
def _forget_programs() -> Iterator[None]:
    """Let traced and compiled programs go once they are gigabytes; until then, files of tests share them."""
    yield
    if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > MOST_KIBIBYTES:
        jax.clear_caches()


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.double)])
def dtype(request: pytest.FixtureRequest) -> Iterator[np.dtype]:
    """Both precisions; in float64 with jax's 64-bit mode on."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture
def x64() -> Iterator[None]:
    """Run the test with jax's 64-bit mode on."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Run the test as a user would, without type checks, to see the library's own refusals."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def sphere() -> Mesh:
    """An irregular closed surface of 642 vertices."""
    return bumpy_sphere(3)


@pytest.fixture(scope="session")
def key() -> jm.Key:
    """A fixed key."""
    return jm.Key(bytes(range(32)))


@pytest.fixture(scope="session")
def hard_graph() -> Mesh:
    """Two components, a boundary, an edge with three faces, a degenerate face and two isolated vertices."""
    vertices = [
        *([0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3], [0.5, 0.5, 1], [9, 9, 9]),
        *([5, 0, 0], [6, 0.2, 0], [5, 1, 0.1], [5.4, 0.4, 0.8], [-7, 0, 0]),
    ]
    faces = [[0, 1, 2], [1, 2, 3], [1, 2, 4], [6, 7, 8], [7, 8, 9], [8, 6, 9], [3, 3, 4]]
    return make_mesh(np.array(vertices, float), np.array(faces))
