"""Save marked files by other programs, and read the marks: python benchmarks/robustness/tools.py [--tools NAME...].

A mesh by formula, the asteroid of 5,000 vertices, is marked once with 64 bits at the default budget, and saved in six
formats. Each program reads a file and writes it again, in its own way: it reorders, merges or splits vertices, rounds,
compresses or simplifies. The result is read without a claim, and only if the message cannot be decoded, with a claim of
it. The table has a row for each program, operation and pair of formats:

    vertices  number of vertices in the file that the program wrote; the marked mesh has 5,000
    message   exact if it was decoded; otherwise claimed, or the reason why the file was not read
    log10 p   bound on the false-positive probability; in square brackets, what it is without its floor
    aligned   how the suspect was aligned with the original
    residual  RMS distance to the aligned original, as a fraction of the bounding-box diagonal

Programs of npm are installed into the user's cache. Rows of programs that are not installed say so.
"""

import locale
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import trimesh

import jaxmark as jm
from jaxmark.files import SUFFIXES
from jaxmark.geometry import asteroid
from jaxmark.geometry.mesh import make_mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser
from common.marks import KEY, MESSAGE
from common.npm import NpmError, install, run_node
from common.tables import Row, evidence, say, table

VERTICES = 5000
SOURCES = (".glb", ".ply", ".obj", ".stl", ".off", ".3mf")  # formats that the marked mesh is saved in
PACKAGES = {"gltfpack": "gltfpack@1.3.0", "gltf-transform": "@gltf-transform/cli@4.5.1", "assimpjs": "assimpjs@0.0.10"}
# Converts a file to GLB: arguments are the folder of the package, the file and the result.
ASSIMPJS = """
const [fs, path, [folder, file, out]] = [require("fs"), require("path"), process.argv.slice(1)];
require(path.join(folder, "assimpjs"))().then((assimp) => {
  const list = new assimp.FileList();
  list.AddFile(path.basename(file), fs.readFileSync(file));
  const result = assimp.ConvertFileList(list, "glb2");
  if (!result.IsSuccess()) throw new Error(result.GetErrorCode());
  fs.writeFileSync(out, result.GetFile(0).GetContent());
});
"""
JOIN, TRIANGULATE = 0x2, 0x8  # flags of Assimp: join identical vertices, split polygons


class MissingError(Exception):
    """A program that is not installed, or a format that jaxmark does not read."""


class Case(NamedTuple):
    """A program that writes a file again."""

    tool: str
    operation: str
    source: str  # the suffix of the file that it reads
    result: str  # the suffix of the file that it writes
    convert: Callable[[Path, Path], object]  # from one path to another
    refused: str = ""  # words of the refusal, if jaxmark does not read the result

    @property
    def name(self) -> str:
        """A name that no other case has."""
        return " ".join(filter(None, (self.tool, self.operation, self.source, self.result)))


class Subject(NamedTuple):
    """The marked mesh."""

    marker: jm.watermark.NonBlindMarker
    files: Mapping[str, Path]  # the marked files, by suffix


def need(name: str) -> Any:
    """Import a module of another program."""
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingError(f"{name} is not installed") from error


def installed(tool: str) -> Path:
    """The folder of a package of npm."""
    try:
        return install(PACKAGES[tool])
    except NpmError as error:
        raise MissingError(str(error)) from error


def gltfpack(*options: str) -> Callable[[Path, Path], object]:
    script = Path("gltfpack") / "cli.js"
    return lambda source, out: run_node(installed("gltfpack") / script, *options, "-i", source, "-o", out)


def gltf_transform(command: str, *options: str) -> Callable[[Path, Path], object]:
    script = Path("@gltf-transform") / "cli" / "bin" / "cli.js"
    return lambda source, out: run_node(installed("gltf-transform") / script, command, source, out, *options)


def assimpjs(source: Path, out: Path) -> None:
    run_node("-e", ASSIMPJS, installed("assimpjs"), source, out)


def assimp_py(source: Path, out: Path) -> None:
    scene = need("assimp_py").import_file(str(source), TRIANGULATE | JOIN)
    (mesh,) = scene.meshes
    faces = np.reshape(mesh.indices, (-1, 3)).astype(np.int64)
    jm.save_mesh(make_mesh(np.reshape(mesh.vertices, (-1, 3)), faces), out)


def by_trimesh(kind: str, **options: Any) -> Callable[[Path, Path], object]:
    def convert(source: Path, out: Path) -> None:
        if kind == "3mf":
            need("lxml")
        written: Any = trimesh.load_mesh(source).export(file_type=kind, **options)
        (data,) = written.values() if isinstance(written, dict) else (written,)
        out.write_bytes(data.encode() if isinstance(data, str) else data)

    return convert


def by_meshlab(source: Path, out: Path) -> None:
    meshes = need("pymeshlab").MeshSet()
    meshes.load_new_mesh(str(source))
    meshes.save_current_mesh(str(out))


def by_lib3mf(source: Path, out: Path) -> None:
    model = need("lib3mf").get_wrapper().CreateModel()
    model.QueryReader(source.suffix[1:]).ReadFromFile(str(source))
    model.QueryWriter(out.suffix[1:]).WriteToFile(str(out))


def draco(bits: int) -> Callable[[Path, Path], object]:
    def convert(source: Path, out: Path) -> None:
        library, mesh = need("DracoPy"), jm.load_mesh(source)
        packed = library.encode(np.asarray(mesh.vertices), np.asarray(mesh.faces), quantization_bits=bits)
        unpacked = library.decode(packed)
        jm.save_mesh(make_mesh(unpacked.points, np.asarray(unpacked.faces, np.int64)), out)

    return convert


def usd(source: Path, out: Path) -> None:
    stages, shapes = need("pxr.Usd"), need("pxr.UsdGeom")
    if out.suffix not in SUFFIXES:
        raise MissingError(f"jaxmark does not read {out.suffix[1:].upper()}")
    mesh, stage = jm.load_mesh(source), stages.Stage.CreateNew(str(out))
    shape = shapes.Mesh.Define(stage, "/mesh")
    shape.CreatePointsAttr(np.asarray(mesh.vertices).tolist())
    shape.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
    shape.CreateFaceVertexIndicesAttr(np.ravel(mesh.faces).tolist())
    stage.Save()


CASES = (
    *(
        Case("gltfpack", " ".join(options), ".glb", ".glb", gltfpack(*options))
        for options in ((), ("-noq",), ("-si", "0.5"), ("-si", "0.25"))
    ),
    Case("gltfpack", "", ".obj", ".glb", gltfpack()),
    Case("gltfpack", "-cc", ".glb", ".glb", gltfpack("-cc"), "meshopt"),
    *(
        Case("gltf-transform", command, ".glb", ".glb", gltf_transform(command))
        for command in ("copy", "weld", "unweld", "reorder", "quantize", "draco")
    ),
    Case("gltf-transform", "simplify", ".glb", ".glb", gltf_transform("simplify", "--ratio", "0.5", "--error", "0.01")),
    Case("gltf-transform", "optimize", ".glb", ".glb", gltf_transform("optimize", "--compress", "draco")),
    Case("gltf-transform", "meshopt", ".glb", ".glb", gltf_transform("meshopt"), "meshopt"),
    *(Case("assimpjs", "", source, ".glb", assimpjs) for source in SOURCES),
    *(Case("assimp-py", "", source, ".ply", assimp_py) for source in SOURCES),
    *(Case("trimesh", "", ".ply", f".{kind}", by_trimesh(kind)) for kind in ("glb", "obj", "ply", "stl", "off", "3mf")),
    Case("trimesh", "", ".ply", ".gltf", by_trimesh("gltf", embed_buffers=True)),
    Case("trimesh", "text", ".ply", ".stl", by_trimesh("stl_ascii")),
    Case("trimesh", "text", ".glb", ".ply", by_trimesh("ply", encoding="ascii")),
    *(Case("PyMeshLab", "", ".ply", suffix, by_meshlab) for suffix in (".ply", ".stl", ".obj", ".off", ".3mf")),
    Case("PyMeshLab", "", ".glb", ".ply", by_meshlab),
    *(Case("lib3mf", "", *suffixes, by_lib3mf) for suffixes in ((".3mf", ".3mf"), (".3mf", ".stl"), (".stl", ".3mf"))),
    *(Case("DracoPy", f"{bits} bits", ".ply", ".ply", draco(bits)) for bits in (16, 14, 11)),
    Case("usd-core", "", ".ply", ".usda", usd),
)


def prepare(folder: Path) -> Subject:
    """Mark the mesh, and save it in all formats."""
    marker = jm.make_marker(asteroid(VERTICES), KEY, bits=8 * len(MESSAGE))
    marked, _ = marker.embed(MESSAGE)
    files = {suffix: folder / f"marked{suffix}" for suffix in SOURCES}
    for file in files.values():
        jm.save_mesh(marked, file)
    return Subject(marker, files)


def read(case: Case, subject: Subject, folder: Path) -> Row:
    """Convert a marked file, and read the result.

    Raises:
        MissingError: if the program is not installed.
    """
    row: Row = {"program": case.tool, "operation": case.operation, "from": case.source[1:], "to": case.result[1:]}
    out = folder / f"converted{case.result}"
    words = locale.setlocale(locale.LC_ALL)
    try:
        case.convert(subject.files[case.source], out)
    except MissingError:
        raise
    except Exception as error:  # whatever another program raises
        return row | {"message": f"the program fails: {type(error).__name__}: {' '.join(str(error).split())}"}
    finally:
        locale.setlocale(locale.LC_ALL, words)  # lib3mf leaves another one, in which files are read as ASCII
    try:
        suspect = jm.load_mesh(out)
        found = subject.marker.detect(suspect)
        decoded = found.message == MESSAGE
        if not decoded:
            found = subject.marker.detect(suspect, MESSAGE)
    except jm.JaxmarkError as error:
        return row | {"message": f"refused: {' '.join(str(error).replace(f'{out}: ', '').split())}"}
    registration = found.registration
    return row | {
        "vertices": len(suspect.vertices),
        "message": "exact" if decoded else "claimed",
        "log10 p": evidence(found.log10_p, found.evidence.log10_p_unfloored),
        "aligned": registration.method,
        "residual": registration.residual,
    }


def rows(cases: Sequence[Case]) -> Iterator[Row]:
    """Mark the mesh, and yield the row of each case."""
    with TemporaryDirectory() as name:
        subject = prepare(Path(name))
        for case in cases:
            say(case.name)
            try:
                yield read(case, subject, Path(name))
            except MissingError as error:
                yield {"program": case.tool, "operation": case.operation, "message": f"not run: {error}"}


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    tools = list(dict.fromkeys(case.tool for case in CASES))
    parser.add_argument("--tools", nargs="+", choices=tools, default=tools, help="programs; by default all")
    chosen = parser.parse_args().tools
    print(table(list(rows([case for case in CASES if case.tool in chosen]))))


if __name__ == "__main__":
    main()
