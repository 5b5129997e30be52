"""The part of the program in `jaxmark.files.unpacker` that reads and changes one layer of USD; it needs `usd-core`.

The layer is opened alone: nothing that it refers to is loaded, and no stage is composed.
"""

import importlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("PXR_WORK_THREAD_LIMIT", "1")  # the stacks of threads would count as memory

Sdf: Any = importlib.import_module("pxr.Sdf")
importlib.import_module("pxr.Usd")  # has the file formats, before version 25.8

BINARY = b"PXR-USDC"
_ARRAYS = ("points", "faceVertexCounts", "faceVertexIndices", "normals", "extent")
_ARCS = ("references", "payload", "inheritPaths", "specializes", "variantSetNames")
_PRIMVARS = {"normals": "primvars:normals", "texture": "primvars:st"}


def unpack(data: bytes) -> dict[str, np.ndarray]:
    """Answer a request: NumPy arrays in the format npz.

    `layer` has the bytes of a layer, and `most` the largest number of bytes that its meshes may have. Without further
    arrays, the answer has `report`, in JSON, and the arrays of each mesh. Otherwise `paths` is a list of attributes, in
    JSON, and the arrays 0, 1, 2 … are their new values; `binary` says whether the changed `layer` of the answer is
    binary. `same_text` of the answer says whether USD writes the text of the unchanged layer as it was.

    Raises:
        ValueError: half a sentence, if USD cannot read the layer, or its meshes have too many bytes.
    """
    folder = tempfile.gettempdir()  # that of this process alone; one for each of many layers would take longer
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        content = arrays["layer"].tobytes()
        # The kind of the content decides, because the suffix usd may name either.
        path = Path(folder, f"layer.{_suffix(content.startswith(BINARY))}")
        path.unlink(missing_ok=True)  # a layer that was read before may still map the bytes
        path.write_bytes(content)
        layer = _native("this is no layer that USD reads", lambda: Sdf.Layer.OpenAsAnonymous(str(path)))
        if "paths" not in arrays:
            most = int(arrays["most"])
            return _native("its data are damaged, or take too much memory", lambda: _read(layer, most))
        same = content.startswith(BINARY) or layer.ExportToString().strip() == content.decode().strip()
        for number, place in enumerate(json.loads(arrays["paths"].tobytes())):
            _set(layer.GetAttributeAtPath(place), arrays[str(number)])
        path = Path(folder, f"changed.{_suffix(bool(arrays['binary']))}")
        _native("USD cannot write it", lambda: layer.Export(str(path)))
        return {"layer": np.frombuffer(path.read_bytes(), np.uint8), "same_text": np.array(same)}


def _suffix(binary: bool) -> str:
    return "usdc" if binary else "usda"


def _native(defect: str, call: Callable[[], Any]) -> Any:
    """Return the answer of USD's native code, whose exceptions name its own source files."""
    try:
        answer = call()
    except (ValueError, MemoryError):
        raise
    except Exception:
        answer = None
    if not answer:
        raise ValueError(defect)
    return answer


def _read(layer: Any, most: int) -> dict[str, np.ndarray]:
    """Read all meshes of a layer, and the paths of files that it refers to."""
    prims, assets = list[Any](), set[str]()

    def visit(path: Any) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec) and (spec.typeName == "Mesh" or "points" in spec.properties):
            prims.append(spec)
        if isinstance(spec, Sdf.AttributeSpec):
            value = spec.default
            found = value if isinstance(value, Sdf.AssetPathArray) else [value]
            assets.update(one.path for one in found if isinstance(one, Sdf.AssetPath))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    meshes, arrays, size = list[dict[str, Any]](), dict[str, np.ndarray](), 0
    for prim in prims:
        if prim.typeName not in ("Mesh", ""):  # points of curves, and the like
            continue
        mesh, found = _mesh(prim)
        size += sum(array.nbytes for array in found.values())
        if size > most:
            raise ValueError(f"its meshes have more than {most} bytes; save it as several files, or as PLY")
        arrays |= {f"{len(meshes)}.{name}": array for name, array in found.items()}
        meshes.append(mesh)
    layers = {*layer.GetCompositionAssetDependencies()}
    report = {
        "meshes": meshes,
        "alone": not layers and not any(map(_is_composed, prims)),
        "layers": sorted(layers - {""}),  # "" is the layer itself
        "assets": sorted(assets - {""}),
    }
    return arrays | {"report": np.frombuffer(json.dumps(report).encode(), np.uint8)}


def _mesh(prim: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read one mesh: what the layer says of it, and its arrays, as far as the layer has them."""
    arrays = {name: _array(prim, name) for name in _ARRAYS} | {"texture": None}
    mesh: dict[str, Any] = {"path": str(prim.path), "samples": 0, "subdivision": _token(prim, "subdivisionScheme")}
    places = {"normals": "normals"}
    for name, primvar in _PRIMVARS.items():
        if (values := _array(prim, primvar)) is not None:  # it hides the attribute without the prefix
            arrays |= {name: values, f"{name}.indices": _array(prim, f"{primvar}:indices")}
            places[name] = primvar
    for name, place in places.items():
        spec: Any = prim.attributes.get(place)
        stated = str(spec.GetInfo("interpolation")) if spec is not None and spec.HasInfo("interpolation") else ""
        mesh[name] = {"attribute": place, "interpolation": stated}
    points = prim.attributes.get("points")
    if points is not None and arrays["points"] is not None:
        mesh["samples"] = sum(not _equal(value, arrays["points"]) for _, value in _slots(points))
    stated = {name: prim.attributes.get(name) for name in _ARRAYS if arrays[name] is None}
    mesh["unread"] = [name for name, spec in stated.items() if spec is not None and any(True for _ in _slots(spec))]
    return mesh, {name: array for name, array in arrays.items() if array is not None}


def _is_composed(prim: Any) -> bool:
    """Whether a prim, or one that it is in, may have values from elsewhere in the layer."""
    while prim is not None and not prim.path.isEmpty:
        if any(prim.HasInfo(name) for name in _ARCS):
            return True
        prim = prim.nameParent
    return False


def _slots(spec: Any) -> Iterator[tuple[float | None, Any]]:
    """Yield the values of an attribute by time; None for the one without a time, which comes last."""
    for time in spec.layer.ListTimeSamplesForPath(spec.path):
        yield time, spec.layer.QueryTimeSample(spec.path, time)
    if spec.HasDefaultValue():
        yield None, spec.default


def _array(prim: Any, name: str) -> np.ndarray | None:
    """Read the first value in time of an attribute that is an array of numbers; None without any."""
    spec = prim.attributes.get(name)
    value = None if spec is None else next((value for _, value in _slots(spec)), None)
    if value is None or not hasattr(value, "FromNumpy"):
        return None
    array = np.array(value)
    return array if array.dtype.kind in "fiu" else None


def _token(prim: Any, name: str) -> str:
    spec = prim.attributes.get(name)
    return str(spec.default) if spec is not None and spec.HasDefaultValue() else ""


def _set(spec: Any, array: np.ndarray) -> None:
    """Write the first value in time of an attribute, and all others that are equal to it."""
    slots = list(_slots(spec))
    old, values = np.array(slots[0][1]), type(slots[0][1]).FromNumpy(np.ascontiguousarray(array))
    for time, value in slots:
        if not _equal(value, old):
            continue
        if time is None:
            spec.default = values
        else:
            spec.layer.SetTimeSample(spec.path, time, values)


def _equal(value: Any, array: np.ndarray) -> bool:
    return hasattr(value, "FromNumpy") and np.array_equal(np.array(value), array)
