"""Write new mesh files, without an existing file to patch."""

import io
import zipfile
from collections.abc import Callable

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_gltf

from jaxmark.errors import JaxmarkError
from jaxmark.files import usd
from jaxmark.files.source import Source
from jaxmark.geometry.mesh import Mesh

_CLOUDS = (".xyz", ".las", ".laz", ".spz")  # formats without faces
_USD = (".usd", ".usda", ".usdc", ".usdz")
_MAX_ROUNDING = 1e-5  # of the bounding-box diagonal; marks move vertices by about ten times that or more


def encode_new(mesh: Mesh, suffix: str, parse: Callable[[bytes], Source]) -> bytes:
    """Encode a mesh as the bytes of a new file, which are read back as a check.

    A mesh is refused if the format cannot hold it: single precision would move a coordinate by more than 1e-5 of the
    diagonal of the bounding box, as it does far from the origin.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if suffix in _CLOUDS and len(faces):
        raise JaxmarkError(f"{suffix[1:].upper()} files hold points without faces; save the mesh as PLY or OBJ.")
    if suffix in (".stl", ".glb", ".vrm", ".gltf", ".3mf", *_USD) and not len(faces):
        raise JaxmarkError(f"A new {suffix[1:].upper()} file holds faces; save the point cloud as PLY or XYZ.")
    if suffix in (".las", ".laz"):
        advice = "pass the one it came from as `like`, or use PLY or XYZ"
        raise JaxmarkError(f"A new LAS or LAZ file is not written; {advice}.")
    if suffix == ".spz":
        raise JaxmarkError("A new SPZ file is not written; use PLY or XYZ.")
    if suffix in (".obj", ".off", ".xyz"):
        data = _text(vertices, faces, suffix)
    elif suffix == ".3mf":
        data = _threemf(vertices, faces)
    elif suffix in _USD:
        vertices = _single(vertices, suffix)
        data = _usda(vertices, faces)
        if suffix == ".usdc":
            data = usd.to_binary(data)
        if suffix == ".usdz":
            data = usd.pack(None, {"mesh.usda": data})
    elif not len(faces):
        vertices = _single(vertices, suffix)
        # trimesh would write a face element, which viewers take for a mesh.
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        head += [*(f"property float {axis}" for axis in "xyz"), "end_header", ""]
        data = "\n".join(head).encode() + vertices.astype("<f4").tobytes()
    else:
        with np.errstate(all="ignore"):
            whole = trimesh.Trimesh(vertices, faces, process=False)
            if suffix == ".gltf":
                (data,) = export_gltf(trimesh.Scene(whole), embed_buffers=True).values()
            else:
                kind = "glb" if suffix == ".vrm" else suffix[1:]
                data = bytes(whole.export(file_type=kind))  # type: ignore[arg-type]
            if suffix == ".stl":
                vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
            vertices = _single(vertices, suffix)
    back = parse(data)
    if not (np.array_equal(back.positions, vertices) and np.array_equal(back.faces, faces)):
        raise JaxmarkError(f"The mesh does not survive being written as {suffix}; use another format.")
    return data


def _single(vertices: np.ndarray, suffix: str) -> np.ndarray:
    """Round to single precision; refused where that moves vertices too far."""
    rounded = vertices.astype(np.float32).astype(np.float64)
    error = np.abs(vertices - rounded).max()
    if not error <= _MAX_ROUNDING * np.linalg.norm(np.ptp(vertices, axis=0)):
        raise JaxmarkError(
            f"The single precision numbers of {suffix[1:].upper()} files would move vertices by {error:.3g},"
            " too far for this mesh; centre it on the origin, or use OBJ or OFF, which are written exactly."
        )
    return rounded


def _text(vertices: np.ndarray, faces: np.ndarray, suffix: str) -> bytes:
    """Encode OBJ, OFF or XYZ with the shortest digits that give exactly the same float64; trimesh fixes decimals."""
    obj = suffix == ".obj"
    head = [] if obj or suffix == ".xyz" else ["OFF", f"{len(vertices)} {len(faces)} 0"]
    point = "v {!r} {!r} {!r}" if obj else "{!r} {!r} {!r}"
    face = "f {} {} {}" if obj else "3 {} {} {}"
    points = [point.format(*row) for row in vertices.tolist()]
    triangles = [face.format(*row) for row in (faces + obj).tolist()]
    return "\n".join([*head, *points, *triangles, ""]).encode()


def _usda(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Encode a layer of USD with one mesh, in text."""
    points = ", ".join("({!r}, {!r}, {!r})".format(*row) for row in vertices.tolist())
    low, high = ("({!r}, {!r}, {!r})".format(*row.tolist()) for row in (vertices.min(axis=0), vertices.max(axis=0)))
    lines = [
        "#usda 1.0",
        '(\n    defaultPrim = "mesh"\n)\n',
        'def Mesh "mesh"\n{',
        f"    float3[] extent = [{low}, {high}]",
        f"    int[] faceVertexCounts = [{', '.join(len(faces) * ['3'])}]",
        f"    int[] faceVertexIndices = [{', '.join(map(str, faces.ravel().tolist()))}]",
        f"    point3f[] points = [{points}]",
        '    uniform token subdivisionScheme = "none"',
        "}",
    ]
    return "\n".join([*lines, ""]).encode()


def _threemf(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Encode 3MF with one object, in millimetres, with digits that give exactly the same float64."""
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    core, package = "http://schemas.microsoft.com/3dmanufacturing", "http://schemas.openxmlformats.org/package/2006"
    points = "".join('<vertex x="{!r}" y="{!r}" z="{!r}"/>\n'.format(*row) for row in vertices.tolist())
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>\n'.format(*row) for row in faces.tolist())
    members = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types">'
        f'<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="{core}/2013/01/3dmodel"/></Relationships>\n',
        "3D/3dmodel.model": f'<model unit="millimeter" xmlns="{core}/core/2015/02">\n'
        f'<resources>\n<object id="1">\n<mesh>\n'
        f"<vertices>\n{points}</vertices>\n<triangles>\n{triangles}</triangles>\n</mesh>\n</object>\n</resources>\n"
        '<build>\n<item objectid="1"/>\n</build>\n</model>\n',
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in members.items():  # a date of its own, so that the same mesh gives the same bytes
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, head + text)
    return packed.getvalue()
