"""The installed core without any extra: mark and read a mesh, and have what is missing name its extra.

Run by itself in a bare environment; pytest does not collect it.
"""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line, as a user calls it."""
    return subprocess.run([sys.executable, "-m", "jaxmark", *arguments], capture_output=True, text=True, check=False)


def main() -> None:
    """Fail loudly where the core does not stand alone."""
    for extra in ("matplotlib", "pymeshlab", "igl"):
        assert importlib.util.find_spec(extra) is None, f"{extra} came with the core"
    import trimesh

    with tempfile.TemporaryDirectory() as folder:
        model, marked, key = (str(Path(folder, name)) for name in ("model.ply", "marked.ply", "owner.key"))
        solid = trimesh.creation.annulus(1.0, 2.0, 1.0).subdivide_to_size(0.12)
        solid.vertices += 0.002 * trimesh.unitize(solid.vertices[:, [1, 2, 0]])
        solid.export(model)
        for arguments in (
            ("keygen", key),
            ("embed", model, marked, "--key", key, "--message", "c0ffee"),
            ("detect", marked, "--original", model, "--key", key, "--bits", "24"),
        ):
            done = run(*arguments)
            assert done.returncode == 0, done.stderr
        assert "c0ffee" in done.stdout
        refused = run("demo", model, "--output", folder)
        assert refused.returncode == 2
        assert "jaxmark[plot]" in refused.stderr, refused.stderr
    print("the core stands alone")


if __name__ == "__main__":
    main()
