"""Pieces of a suspect: its meshes, and the large components of each; their number is limited."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, area, compact, components, weld, weld_mesh

_MOST_PIECES = 32  # most pieces of a suspect, the largest ones
_MOST_COMPONENTS = 8  # most components of a mesh
_LEAST_SHARE = 0.02  # least area of a component, as a fraction of the mesh's area
_LEAST_FACES = 50  # least number of faces of a component, or of one of several meshes
_MOST_NAMED = 5  # most names of pieces that are left out
_ALONE = "to search one of them, save it as a file of its own"
_SMALL = f"in a file of several meshes, a mesh is searched if it has {_LEAST_FACES} faces or more; {_ALONE}"
_MANY = f"only the {_MOST_PIECES} largest pieces of a file are searched; {_ALONE}"


class Piece(NamedTuple):
    """A mesh that may be a copy of an original, or of a part of one."""

    name: str  # name of the mesh in the suspect's file, and number of its component
    mesh: Mesh
    within: str  # name of the piece that it is a component of; empty if it is a whole mesh


class LeftOut(NamedTuple):
    """Pieces of a suspect that were not searched, for one reason."""

    number: int
    names: tuple[str, ...]  # the first of their names
    reason: str

    @classmethod
    def of(cls, pieces: Sequence[Piece], reason: str) -> "tuple[LeftOut, ...]":
        """Describe the pieces that were left out; returns an empty tuple if there are none."""
        return (cls(len(pieces), tuple(piece.name for piece in pieces[:_MOST_NAMED]), reason),) if pieces else ()


def split(meshes: Mapping[str, Mesh]) -> tuple[list[Piece], tuple[LeftOut, ...]]:
    """Split a suspect into pieces: its distinct meshes, then the components of meshes with several large ones.

    If there are several meshes, those with few faces are left out: they carry no mark, and there may be thousands of
    them.

    Returns:
        The pieces, and those that were left out.
    """
    distinct: dict[bytes, Piece] = {}
    for name, mesh in meshes.items():
        distinct.setdefault(geometry_hash(mesh), Piece(name, mesh, ""))
    readable = [piece for piece in distinct.values() if len(distinct) == 1 or _is_readable(piece.mesh)]
    small = [piece for piece in distinct.values() if len(distinct) > 1 and not _is_readable(piece.mesh)]
    wholes = sorted(readable, key=lambda piece: -len(piece.mesh.faces))
    pieces = [*wholes]
    for piece in wholes[:_MOST_PIECES]:
        parts = _components(piece.mesh)
        if len(parts) > 1:
            names = (f"{piece.name}#{number}".lstrip() for number in range(1, len(parts) + 1))
            pieces += [Piece(name, part, piece.name) for name, part in zip(names, parts, strict=True)]
    left_out = LeftOut.of(small, _SMALL) + LeftOut.of(pieces[_MOST_PIECES:], _MANY)
    return pieces[:_MOST_PIECES], left_out


def _is_readable(mesh: Mesh) -> bool:
    """Whether a mesh has enough faces, or is a point cloud."""
    return not len(mesh.faces) or len(mesh.faces) >= _LEAST_FACES


def _components(mesh: Mesh) -> list[Mesh]:
    """Return the largest components of a surface; small components are left out."""
    if not len(mesh.faces):
        return []
    welded = weld_mesh(mesh, weld(mesh.vertices))
    least = _LEAST_SHARE * area(welded)
    parts = components(welded, _MOST_COMPONENTS)
    return [compact(part) for part in parts if len(part.faces) >= _LEAST_FACES and area(part) >= least]
