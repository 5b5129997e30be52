"""Where the shared test meshes are; tests that need one skip by name where it is absent."""

import os
from pathlib import Path

import pytest

MESHES = Path(os.environ.get("JAXMARK_MESHES", Path(__file__).parents[1] / ".." / "shared" / "meshes")).resolve()


def shared_mesh(name: str) -> Path:
    """The path of a shared mesh (`models/spot.obj`), or a skip that names it."""
    path = MESHES / name
    if not path.is_file():
        pytest.skip(f"shared mesh {name} is absent (set JAXMARK_MESHES)")
    return path


def shared_meshes(folder: str) -> list[Path]:
    """All shared meshes of a folder, none where it is absent."""
    return sorted(path for path in (MESHES / folder).glob("*") if path.is_file())
