"""Parse 3MF: ZIP archives of models in XML."""

import posixpath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.limits import RunningCount
from jaxmark.files.source import Faces, JoinedNumbers, Part, Patched, Source, concerning, splice, unique_names, unusable
from jaxmark.files.text import Spans, TextNumbers
from jaxmark.files.threemf_xml import NO_TRIPLES, Model, RawMesh, read_relationships
from jaxmark.files.zipped import Archive, Member
from jaxmark.geometry.pose import Points

_MODEL = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_DEFAULT = "3D/3dmodel.model"
# Relationships of encrypted content; namespaces alone are declared by programs that encrypt nothing.
_SECURED = (b"schemas.microsoft.com/3dmanufacturing/2019/04/keystore", b"package/2006/relationships/encryptedfile")
_SIGNED = b"package/2006/relationships/digital-signature/"
_SIGNED_FILE = "The file is signed, and a mark would break the signature; mark it before it is signed."
_SIGNATURES = ("_xmlsignatures/", "package/services/digital-signature/")


class _Object(NamedTuple):
    name: str
    numbers: TextNumbers
    faces: Faces


class _Model(NamedTuple):
    member: Member
    data: bytes
    numbers: JoinedNumbers  # of all of its objects


def parse(data: bytes) -> Source:
    """Read the meshes of all objects, in all models of the archive.

    Positions are those of the objects: transformations of components and of what is built are not applied, so an object
    that is used several times is there once.

    Raises:
        JaxmarkError: if the archive or a model cannot be read, is encrypted, or has no mesh that can be marked.
    """
    archive = Archive(data)
    signed = _is_signed(archive)
    found: list[tuple[Member, bytes, list[RawMesh]]] = []
    elements, counted = (RunningCount(limit, len(data)) for limit in (limits.ELEMENTS, limits.MESHES))
    for member in _model_members(archive, elements):
        content = archive.read(member)
        with concerning(member.shown):
            found.append((member, content, Model(content, elements, counted).meshes))
    names = iter(unique_names(mesh.name for _, _, meshes in found for mesh in meshes))
    models: list[_Model] = []
    parts: list[Part] = []
    skipped: dict[str, str] = {}
    size = 0
    for member, content, meshes in found:
        with concerning(member.shown):
            objects = _read_objects(content, meshes, names, skipped)
        for item in objects:
            parts.append(Part(item.name, size + np.arange(len(item.numbers.values)), item.faces))
            size += len(item.numbers.values)
        if objects:
            models.append(_Model(member, content, JoinedNumbers([item.numbers for item in objects])))
    if not parts and len(skipped) == 1:
        raise JaxmarkError("The mesh {!r} cannot be marked: {}.".format(*skipped.popitem()))
    if not parts:
        raise JaxmarkError(unusable(skipped, len(skipped)) if skipped else "The file has no object with a mesh.")
    return _ThreemfSource(
        data,
        JoinedNumbers([model.numbers for model in models]),
        np.concatenate([part.places[0] + part.faces for part in parts]),
        parts=parts if len(parts) + len(skipped) > 1 else (),
        skipped=skipped,
        archive=archive,
        models=models,
        fixed=_SIGNED_FILE if signed else "",
    )


def _is_signed(archive: Archive) -> bool:
    """Whether the archive has a signature, which a mark would break; encrypted archives are refused."""
    signed = any(member.name.casefold().startswith(_SIGNATURES) for member in archive.members)
    for member in archive.members:
        if member.name.casefold().endswith(".rels"):
            content = archive.read(member)
            if any(word in content for word in _SECURED):
                raise JaxmarkError("Parts of the file are encrypted (Secure Content); save it without.")
            signed |= _SIGNED in content
    return signed


def _model_members(archive: Archive, elements: RunningCount) -> list[Member]:
    """Find the members that are models, in the order of the archive."""
    root = _DEFAULT
    relationships = archive.find("_rels/.rels")
    if relationships is not None:
        with concerning(relationships.shown):
            targets = [
                target for kind, target in read_relationships(archive.read(relationships), elements) if kind == _MODEL
            ]
        if targets:
            root = posixpath.normpath("/" + unquote(targets[0])).lstrip("/")
    first = archive.find(root)
    if first is None:
        raise JaxmarkError(f"The archive has no model {ascii(root)[:80]}, so it is no whole 3MF file.")
    return [
        member
        for member in archive.members
        # Beside each file, some systems put one of their own, whose name begins so.
        if member is first or (member.name.casefold().endswith(".model") and "/._" not in "/" + member.name)
    ]


def _read_objects(
    content: bytes, meshes: Sequence[RawMesh], names: Iterator[str], skipped: dict[str, str]
) -> list[_Object]:
    """Read the numbers of a model's meshes; those that cannot be marked are put into `skipped`.

    The lists of the meshes are emptied, because they take several times the memory of the numbers.
    """
    lists = [mesh.lists.pop(kind, NO_TRIPLES) for mesh in meshes for kind in ("vertices", "triangles")]
    ends = 3 * np.cumsum([len(one) for one in lists])
    spans = np.concatenate([NO_TRIPLES, *lists])
    lists.clear()
    text = Spans(content, spans[..., 0].ravel(), spans[..., 1].ravel())
    del spans
    pieces = (np.arange(start, end).reshape(-1, 3) for start, end in pairwise([0, *ends]))
    objects = []
    for _ in meshes:
        name, numbers, faces = next(names), TextNumbers(text, next(pieces)), text.read(next(pieces), int)
        outside = ((faces < 0) | (faces >= len(numbers.values))).any(axis=1)
        if not len(faces):
            skipped[name] = "it has no triangles, and beams and the like cannot be marked"
        elif outside.any():
            bad = int(np.argmax(outside))
            skipped[name] = (
                f"its triangle {bad} (zero-based) refers to vertices {faces[bad].tolist()}, but it has"
                f" {len(numbers.values)}, numbered from 0"
            )
        else:
            objects.append(_Object(name, numbers, faces))
    return objects


@dataclass(kw_only=True)
class _ThreemfSource(Source):
    """A source whose positions are in packed members of an archive."""

    archive: Archive
    models: Sequence[_Model]

    def patch(self, positions: Points, name: str) -> Patched:
        """Write these positions into the file; members whose positions do not change stay as they are packed."""
        contents: dict[str, bytes] = {}
        ends = np.cumsum([len(model.numbers.values) for model in self.models])
        for model, piece in zip(self.models, np.split(positions, ends[:-1]), strict=True):
            content = splice(model.data, model.numbers.edits(piece))
            if content != model.data:
                contents[model.member.name] = content
        if not contents:
            return Patched(self.data)
        return Patched(self.archive.replaced(contents))
