"""Primitives that are compressed with Draco: decoded, and encoded again. Needs the extra `files`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Shaped

from jaxmark.errors import JaxmarkError, require
from jaxmark.files.gltf.document import COMPONENTS, Document, Elements, whole
from jaxmark.files.gltf.views import is_alone, replace
from jaxmark.files.source import Faces

EXTENSION = "KHR_draco_mesh_compression"
_POSITION_BITS = 24  # as fine as single precision


@dataclass
class Compressed:
    """The content of a compressed primitive."""

    view: int  # index of the buffer view
    attributes: dict[str, Elements]  # decoded, by name, behind the buffers of the container
    faces: Faces


def decompress(document: Document, primitive: dict[str, Any], where: str) -> Compressed | None:
    """Decode a primitive, and let the document read its accessors from there; None if it is not compressed.

    It is refused if the decoder is missing, or finds something else than the document promises.
    """
    extensions = primitive.get("extensions")
    if not isinstance(extensions, dict) or EXTENSION not in extensions:
        return None
    extension, attributes = extensions[EXTENSION], primitive.get("attributes")
    named = extension.get("attributes") if isinstance(extension, dict) else None
    if not isinstance(named, dict) or not isinstance(attributes, dict) or not named.keys() <= attributes.keys():
        raise JaxmarkError(f"The extension {EXTENSION} of {where} is damaged.")
    view = whole(extension, "bufferView", where)
    begin, length = document.view(view)
    indices = {name: whole(attributes, name, where) for name in named}
    forms = {name: document.form(index) for name, index in indices.items()}
    # The announced size must be possible, before the decoder reserves memory for it.
    document.unpacked.add(sum(dtype.itemsize * width * count for dtype, width, _, count in forms.values()))
    document.accessed.add(sum(count for _, _, _, count in forms.values()))
    document.unpacked.add(length)  # because many primitives may name the same view
    try:
        found = document.draco(bytes(document.data[begin : begin + length]))
    except JaxmarkError as error:
        raise JaxmarkError(f"{where} cannot be decoded by Draco: {error}.") from None
    faces = found["faces"]
    document.accessed.add(len(faces))
    decoded = {}
    for name, (dtype, width, _, count) in forms.items():
        data = found.get(str(whole(named, name, where)))
        if data is None or data.reshape(len(data), -1).shape != (count, width):
            raise JaxmarkError(f"{where} holds other numbers of {name} than the document says.")
        decoded[name] = data.astype(dtype).tobytes()
    count = forms["POSITION"][3] if "POSITION" in forms else 0
    if ((faces < 0) | (faces >= count)).any() or not count:
        raise JaxmarkError(f"{where} holds no positions, or faces of other points.")
    places = {}
    for name, (dtype, width, unit, count) in forms.items():
        starts = document.add(decoded[name]) + dtype.itemsize * width * np.arange(count)
        places[name] = Elements(starts, dtype, width, unit)
        if indices[name] not in document.decoded:
            document.decoded.add(indices[name])
            document.located[indices[name]] = places[name]
    return Compressed(view, places, faces)


def _encode(
    attributes: dict[str, Shaped[np.ndarray, "points width"]], faces: Faces
) -> tuple[bytes, dict[str, int]] | None:
    """Encode a primitive, points and faces in their order, all but positions without loss.

    Returns the bytes, and the identifiers of the attributes in them; None if the encoder cannot do that.
    """
    points = attributes["POSITION"]
    others = {name: data for name, data in attributes.items() if name != "POSITION"}
    if points.dtype.kind != "f" or any(data.dtype.kind == "i" for data in others.values()):
        return None  # it knows no signed integers
    ids = {name: index for index, name in enumerate(others)}
    codec = require("DracoPy", "files")
    try:
        coded = codec.encode(
            points,
            faces.astype(np.uint32),
            quantization_bits=_POSITION_BITS,
            preserve_order=True,
            generic_attributes={ids[name]: data for name, data in others.items()} or None,
        )
        back = codec.decode(coded)
        found = {item["unique_id"]: np.asarray(item["data"]) for item in back.attributes}
        ids["POSITION"] = next(item["unique_id"] for item in back.attributes if item["attribute_type"] == 0)
        kept = np.array_equal(back.faces, faces) and found[ids["POSITION"]].shape == points.shape
        for name, data in others.items():
            kept &= np.array_equal(found[ids[name]].reshape(data.shape), data)
    except Exception:  # whatever it does not know
        return None
    return (bytes(coded), ids) if kept else None


def write(
    document: dict[str, Any],
    contents: list[bytes | None],
    primitive: dict[str, Any],
    old: Compressed,
    data: bytes,
) -> bool:
    """Write changed attributes of a compressed primitive into a document and its buffers.

    The bytes that were there are replaced, for they hold the primitive as it was. `contents` are the buffers, which
    change with the document, and `data` are those of the document with the new numbers. Returns whether the primitive
    is still compressed: the encoder does not know all types.
    """
    attributes = {
        name: np.frombuffer(data[rows.span], rows.dtype).reshape(-1, rows.width)
        for name, rows in old.attributes.items()
    }
    coded = _encode(attributes, old.faces)
    if coded is not None:
        blob, primitive["extensions"][EXTENSION]["attributes"] = coded
        (primitive["extensions"][EXTENSION]["bufferView"],) = _place(document, contents, old.view, [(blob, {})])
        return True
    # Vertex attributes begin at multiples of four bytes.
    arrays = [(primitive["attributes"][name], rows, 4) for name, rows in attributes.items()]
    if "indices" in primitive:
        component = document["accessors"][primitive["indices"]]["componentType"]
        arrays.append((primitive["indices"], old.faces.reshape(-1, 1).astype(COMPONENTS[component]), 1))
    blocks = []
    for _, rows, step in arrays:
        size = rows.shape[1] * rows.dtype.itemsize
        padded = np.pad(rows.view(np.uint8), ((0, 0), (0, -size % step)))
        blocks.append((padded.tobytes(), {} if padded.shape[1] == size else {"byteStride": padded.shape[1]}))
    for (index, *_), view in zip(arrays, _place(document, contents, old.view, blocks), strict=True):
        document["accessors"][index]["bufferView"] = view
        document["accessors"][index].pop("byteOffset", None)
    del primitive["extensions"][EXTENSION]
    if not primitive["extensions"]:
        del primitive["extensions"]
    return False


def _place(
    document: dict[str, Any], contents: list[bytes | None], view: int, blocks: Sequence[tuple[bytes, dict[str, int]]]
) -> list[int]:
    """Replace a buffer view by views of blocks of bytes, each with further properties; returns their indices.

    If something else needs the bytes of the view, the blocks follow at the end of the buffer.
    """
    views = document["bufferViews"]
    mine, alone = views[view], _users(document, view) == 1 and is_alone(document, views[view])
    added, placed = b"", list[dict[str, int]]()
    for block, properties in blocks:
        added += bytes(-len(added) % 4)
        placed.append({"buffer": mine["buffer"], "byteOffset": len(added), "byteLength": len(block)} | properties)
        added += block
    begin = replace(document, contents, mine, added, alone=alone)
    for place in placed:
        place["byteOffset"] += begin
    indices = [view, *range(len(views), len(views) + len(placed) - 1)]
    if alone:
        views[view] = placed.pop(0)
    else:
        indices = list(range(len(views), len(views) + len(placed)))
    views += placed
    return indices


def _users(document: dict[str, Any], view: int) -> int:
    """Count the compressed primitives, accessors and images that use a buffer view."""
    primitives = [one for mesh in document["meshes"] for one in mesh["primitives"]]
    owners = [one["extensions"][EXTENSION] for one in primitives if EXTENSION in one.get("extensions", {})]
    owners += [*document.get("accessors", []), *document.get("images", [])]
    return [one["bufferView"] for one in owners if "bufferView" in one].count(view)


def forget_unused(document: dict[str, Any]) -> None:
    """Remove the extension from the lists of used extensions, if no primitive is compressed any more."""
    for mesh in document.get("meshes", []):
        if any(EXTENSION in primitive.get("extensions", {}) for primitive in mesh.get("primitives", [])):
            return
    for key in ("extensionsUsed", "extensionsRequired"):
        if EXTENSION in document.get(key, []):
            document[key] = [name for name in document[key] if name != EXTENSION]
            if not document[key]:
                del document[key]
