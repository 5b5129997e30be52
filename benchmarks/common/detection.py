"""Detection in a separate process, from files."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jaxmark as jm
from common.timing import timed
from jaxmark.geometry.mesh import Mesh


@contextmanager
def compilation_cache() -> Iterator[None]:
    """What processes compile meanwhile, those that come after need not."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = cache
        yield


def detect(
    marker: jm.watermark.NonBlindMarker,
    suspect: Mesh,
    source: Path,
    suffix: str,
    *,
    like: Path | None = None,
) -> tuple[subprocess.CompletedProcess[str], float]:
    """Run `jaxmark detect` on a suspect's file.

    Args:
        marker: has key, payload and scheme.
        suspect: any mesh.
        source: the original's file.
        suffix: of the suspect's file.
        like: see `jaxmark.save_mesh`.

    Returns:
        The process, and its seconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        file, key = Path(folder) / f"suspect{suffix}", Path(folder) / "owner.key"
        jm.save_mesh(suspect, file, like=like)
        jm.watermark.save_key(marker.key, key)
        options = f"-m jaxmark detect --bits {marker.bits} --scheme {marker.scheme.name} --json".split()
        command = [sys.executable, *options, file, "--original", source, "--key", key]
        ended, seconds = timed(subprocess.run, command, capture_output=True, text=True)
    ended.stderr = ended.stderr.replace(f"{folder}/", "")
    return ended, seconds
