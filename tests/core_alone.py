"""The installed core without any extra: mark and read a mesh, and have what is missing name its extra.

Run by itself in a bare environment into which the package was installed; pytest does not collect it.
"""

import importlib.metadata
import importlib.resources
import importlib.util
import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

LATE = {"trimesh", "jaxopt", "click", "scipy.optimize", "scipy.stats", "scipy.ndimage", "matplotlib", "pandas"}
REMESHING = {"simplification": 0.5, "isotropic": 1, "iso-surface": 20, "poisson": 5, "arap": 0.05}


def _compressed(primitive: dict[str, object], view: dict[str, object]) -> bytes:
    """A glTF file with extensions of its primitive and its buffer view."""
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "extensions": primitive}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36, "extensions": view}],
        "buffers": [{"byteLength": 36, "uri": f"data:;base64,{48 * 'A'}"}],
    }
    return json.dumps(document).encode()


_STORED = {"buffer": 0, "byteLength": 36, "byteStride": 12, "count": 3, "mode": "ATTRIBUTES"}
COMPRESSED = {
    "Draco": _compressed({"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}, {}),
    "meshopt": _compressed({}, {"EXT_meshopt_compression": _STORED}),
}


def run(folder: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python as a user calls it, from a folder where only the installed package is found."""
    return subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False)


def check_package() -> None:
    """What is imported is an installed package with its types, and no extra came with it."""
    package = importlib.resources.files("jaxmark")
    assert package.joinpath("py.typed").is_file(), "the wheel has no py.typed"
    assert not Path(str(package)).is_relative_to(Path(__file__).parents[1] / "jaxmark"), f"{package} is the checkout"
    others = ("fast_simplification", "skimage", "igl", "flip_evaluator", "distributed", "equinox", "starlette")
    for extra in ("matplotlib", "pandas", "pymeshlab", *others):
        assert importlib.util.find_spec(extra) is None, f"{extra} came with the core"


def check_import(folder: str) -> None:
    """What is used every day is imported without the slow packages that only some calls need.

    Modules are compared instead of seconds, which depend on the machine and on its other work.
    """
    code = f"import sys; from jaxmark import embed, detect; print(*({LATE} & set(sys.modules)))"
    done = run(folder, "-c", code)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.strip(), f"from jaxmark import embed, detect also imports {done.stdout.strip()}"


def check_command_line(folder: str) -> None:
    """A mesh is marked, attacked and read from the shell."""
    import trimesh

    solid = trimesh.creation.annulus(1.0, 2.0, 1.0).subdivide_to_size(0.12)
    assert isinstance(solid, trimesh.Trimesh)
    solid.vertices += 0.002 * trimesh.unitize(solid.vertices[:, [1, 2, 0]])
    solid.export(Path(folder, "model.ply"))
    for line in (
        "keygen owner.key",
        "embed model.ply marked.ply --key owner.key --message c0ffee",
        "attack marked.ply suspect.ply noise 0.001",
        "detect suspect.ply --original model.ply --key owner.key --bits 24",
    ):
        done = run(folder, "-m", "jaxmark", *line.split())
        assert done.returncode == 0, done.stderr
    assert "c0ffee" in done.stdout
    refused = run(folder, "-m", "jaxmark", "demo", "model.ply", "--output", "demo")
    assert refused.returncode == 2
    assert "jaxmark[plot]" in refused.stderr, refused.stderr


def needing(folder: str) -> Iterator[tuple[str, str, Callable[[], object]]]:
    """What needs an extra: its name, the extra, and a call of it."""
    import jaxmark as jm
    from jaxmark import plot
    from jaxmark.app.demo import sample_mesh
    from jaxmark.app.serving import Desk, make_app
    from jaxmark.evaluation.study_results import Results
    from jaxmark.geometry.surfaces import Surface
    from jaxmark.spectral import learned

    mesh = jm.load_mesh(Path(folder, "model.ply"))
    yield "pictures of meshes", "plot", lambda: plot.draw([plot.View("model", mesh)])
    yield "the viewer", "plot", lambda: plot.show(mesh)
    yield "pictures of studies", "plot", lambda: Results(()).plot()
    yield "tables of studies", "study", lambda: Results(()).frame()
    yield "closest points", "align", lambda: Surface(mesh).closest(mesh.vertices)
    for name, data in COMPRESSED.items():
        packed = Path(folder, f"{name}.gltf")
        packed.write_bytes(data)
        yield name, "files", lambda packed=packed: jm.load_mesh(packed)
    layer = Path(folder, "layer.usda")
    layer.write_bytes(b"#usda 1.0")
    yield "USD", "usd", lambda: jm.load_mesh(layer)
    splat = Path(folder, "splat.spz")
    splat.write_bytes(b"NGSP" + bytes([4, 0, 0, 0, 1] + 11 * [0]))
    yield "SPZ", "files", lambda: jm.load_mesh(splat)
    laser = Path(folder, "scan.las")
    laser.write_bytes(b"LASF")
    yield "laser scans", "files", lambda: jm.load_mesh(laser)
    yield "modules of learned filters", "learned", lambda: learned.ChebConv
    yield "the page of a catalogue", "serve", lambda: make_app(Desk(Path("shop.db"), []), 1)
    yield "the sample mesh", "attacks", sample_mesh
    for name, strength in REMESHING.items():
        yield name, "attacks", lambda name=name, strength=strength: jm.attack(mesh, name, strength, seed=0)


def refusal(call: Callable[[], object]) -> str:
    """What is said instead of doing it."""
    from jaxmark.errors import JaxmarkError

    try:
        call()
    except JaxmarkError as error:
        return str(error)
    return "nothing was refused"


def check_extras(folder: str) -> None:
    """What lacks an extra is refused with its name."""
    for name, extra, call in needing(folder):
        said = refusal(call)
        assert f"pip install 'jaxmark[{extra}]'" in said, f"{name}: {said}"


def check_tuning() -> None:
    """What only tuning imports is there: of two equal bands, each has half of the budget."""
    import jax.numpy as jnp

    from jaxmark.evaluation.allocation import allocate
    from jaxmark.evaluation.channels import Channels

    alike = Channels(jnp.ones((1, 2)), jnp.ones((1, 2)), jnp.ones((1, 2)))
    strengths = allocate(alike, jnp.ones(2))
    assert abs(strengths**2 - 0.5).max() < 1e-3, strengths


def main() -> None:
    """Fail loudly where the core does not stand alone."""
    check_package()
    with tempfile.TemporaryDirectory() as folder:
        check_import(folder)
        check_command_line(folder)
        check_extras(folder)
    check_tuning()
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("jax", "numpy", "trimesh"))
    print(f"the core stands alone: Python {platform.python_version()}, {versions}")


if __name__ == "__main__":
    main()
