"""Identify the originals that a suspect was made of, under which keys and for whom, and how surely.

The originals that look most like the suspect are found without any key. Only these are aligned and read, but the
significance budget covers every original of the catalogue with every key, record and list of recipients.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
from scipy.spatial import KDTree

from jaxmark.alignment.result import Align
from jaxmark.catalogue import descriptors
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.landmarks import landmarks
from jaxmark.catalogue.originals import meshes_of
from jaxmark.catalogue.partial_registration import Part, fit_whole
from jaxmark.catalogue.retrieval import Index, Near, state_of
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash
from jaxmark.geometry.canonical import geometry_hash
from jaxmark.geometry.mesh import Mesh, area, compact, components, weld, weld_mesh
from jaxmark.geometry.pose import Points, Pose
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.everyday import alternatives
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.record import Record, is_recorded
from jaxmark.watermark.tracing.tracer import make_tracer

DEPTH = 3  # originals that are aligned and read for each piece, for each way of retrieval
_ALIKE = 100  # originals that a whole is fitted to
_LIKELY = 2000  # originals of which a part may look like a piece
_REFERENCES = 6  # of these, of different shapes, by which its pose is found
_KIN = 200  # originals like a reference that a part is fitted to
_DEEP_PIECES = 3  # of a suspect; of all others, the likeliest original alone is looked at
_WHOLE = 0.95  # share of an original from which on a piece is taken for all of it
_MOST_PIECES = 32  # of a suspect, the largest ones
_MOST_COMPONENTS = 8  # of a mesh
_LEAST_SHARE = 0.02  # of a mesh's area, below which a component is no piece of its own
_LEAST_FACES = 50  # of a component
_NEAR = 0.01  # distance from an original, over its size, up to which a piece is explained by it


class Match(NamedTuple):
    """An original that a piece of a suspect was compared with."""

    original: str  # path of its file
    mesh: str  # name of its mesh in the file; empty if it is the only one
    piece: str  # name of the suspect's piece; empty if it is the whole file
    by: str  # the way of retrieval: by its "landmarks", as a "whole" or as a "part"
    rank: int  # among the originals that look like the piece, from 1
    distance: float  # of descriptors for wholes; else the residual, in mean distances to the centre
    named: bool = False  # whether the probability is at most alpha
    message: str | None = None  # hexadecimal
    recipient: str | None = None
    accused: tuple[str, ...] = ()  # all recipients that are named
    log10_p: float = 0.0  # log10 of a bound on the probability of any such naming, of all that could have been named
    log10_p_uncommitted: float = 0.0  # the same if nothing fixes keys, originals and records beforehand
    key: str | None = None  # commitment to the key that was read with
    record: str | None = None  # its digest
    coverage: float = 0.0  # share of the original that the piece shows
    residual: float | None = None  # of the alignment, in diagonals
    caveats: tuple[str, ...] = ()  # reasons why the probabilities are estimates
    notes: tuple[str, ...] = ()
    refused: str | None = None  # the reason if it could not be read

    @property
    def order(self) -> tuple[bool, float, bool, float]:
        """The key by which likelier matches are sorted first."""
        return not self.named, self.log10_p, self.refused is not None, self.rank


class Verdict(NamedTuple):
    """The originals that a suspect was identified with."""

    suspect: str  # SHA-256 of its file, hexadecimal; empty for a mesh that is no file
    matches: tuple[Match, ...]  # all comparisons, the likeliest first
    readings: int  # readings that could have been made, by whose number all probabilities are corrected

    @property
    def named(self) -> tuple[Match, ...]:
        """The originals that are named, each once."""
        found: dict[tuple[str, str], Match] = {}
        for match in self.matches:
            if match.named:
                found.setdefault((match.original, match.mesh), match)
        return tuple(found.values())

    def as_json(self) -> dict[str, Any]:
        """Return the verdict as values for JSON; its head is the likeliest match, if any is named."""
        best = self.named[0] if self.named else None
        head = {name: getattr(best, name, None) for name in ("original", "mesh", "message", "recipient")}
        return {
            "named": best is not None,
            **head,
            "log10_p": min((match.log10_p for match in self.matches), default=0.0),
            "log10_p_uncommitted": min((match.log10_p_uncommitted for match in self.matches), default=0.0),
            "readings": self.readings,
            "suspect_sha256": self.suspect or None,
            "matches": [match._asdict() for match in self.matches],
        }


class Piece(NamedTuple):
    """A mesh that may be a copy, or a part of one."""

    name: str  # of the mesh in the suspect's file, and the number of its component
    mesh: Mesh
    within: str  # the name of the piece that it is a component of; empty if it is a whole mesh


class _Comparison(NamedTuple):
    """A piece of a suspect beside an original."""

    match: Match  # with the result, once it is read
    original: Mesh
    suspect: Mesh
    readings: int
    pose: Pose | None = None  # of the suspect on the original
    agrees: bool = True  # whether the record that was read with commits to the result


@runtime_checkable
class Originals(Protocol):
    """Originals in a database, such as a `Catalogue`."""

    database: Database

    def load(self, shape: int) -> Mesh:
        """Read the mesh of an original."""
        ...


#: Any kind of `Originals`.
AnyOriginals = TypeVar("AnyOriginals", bound=Originals)


class Finder(Generic[AnyOriginals]):
    """A search for the originals of many suspects in one catalogue, which keeps the descriptors in memory.

    Args:
        catalogue: may be opened for reading only.
        keys: the keys that marks may have been made with.
        alpha: largest false-positive probability at which an original is named.
        bits: payload of messages without a record; by default 64.
        depth: how many originals are aligned and read for each piece of a suspect, for each way of retrieval.
        align: how suspects are aligned, see `detect`; other ways than "auto" are charged.
        only_recipients: whether to look for recipients' copies only.

    Raises:
        JaxmarkError: if there is no key, or a number is out of range.
    """

    def __init__(
        self,
        catalogue: AnyOriginals,
        keys: Sequence[bytes],
        *,
        alpha: float = 1e-6,
        bits: int | None = None,
        depth: int = DEPTH,
        align: Align = "auto",
        only_recipients: bool = False,
    ) -> None:
        if not keys:
            raise JaxmarkError("Marks are read with a key; give one at least.")
        if not 0 < alpha < 1:
            raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
        if depth < 1:
            raise JaxmarkError(f"At least one original is looked at, not {depth}.")
        if align not in get_args(Align):
            raise JaxmarkError(f"A suspect is aligned by {', '.join(get_args(Align))}, not {align!r}.")
        self.catalogue, self.alpha, self.bits, self.depth = catalogue, alpha, bits, depth
        self.align: Align = align
        self.keys = {commitment(key): Key(key) for key in keys}
        self.only_recipients = only_recipients
        self._index: Index | None = None

    @property
    def index(self) -> Index:
        """The descriptors of all originals, as the catalogue has them now."""
        if self._index is None or self._index.state != state_of(self.catalogue.database):
            self._index = Index(self.catalogue.database)
        return self._index

    def prepare(self) -> None:
        """Read the descriptors now, not with the first suspect.

        Raises:
            JaxmarkError: if the catalogue is empty or damaged.
        """
        self._index = Index(self.catalogue.database)

    def find(self, suspect: str | os.PathLike[str] | Mesh) -> Verdict:
        """Find the originals that a suspect was made of.

        Args:
            suspect: a mesh or a file, of one mesh or several; in any pose and scale, whole or in part.

        Raises:
            JaxmarkError: if the suspect cannot be read, or the catalogue is empty or damaged.
        """
        meshes = {"": suspect} if isinstance(suspect, Mesh) else meshes_of(suspect).meshes
        digest = "" if isinstance(suspect, Mesh) else file_hash(suspect)
        pieces = split(meshes)
        readings = len(pieces) * self._readings()
        matches: list[Match] = []
        explained: set[str] = set()
        for number, piece in enumerate(pieces):
            if piece.name in explained:
                continue
            for found in self._compare(piece, self.depth if number < _DEEP_PIECES else 1, readings):
                matches.append(found.match)
                if found.match.named and found.pose is not None:
                    inside = [one for one in pieces if one.within == piece.name]
                    explained |= {one.name for one in inside if _is_explained(one.mesh, found.pose, found.original)}
                    break
        return Verdict(digest, tuple(sorted(matches, key=lambda match: match.order)), readings)

    def _readings(self) -> int:
        """Count the readings of a piece that are possible, of which any could have named an original."""
        rows = self.catalogue.database.rows
        total, shapes = 0, rows("SELECT count(*) FROM shapes")[0][0]
        for key in self.keys:
            total += rows("SELECT count(DISTINCT shape) FROM copies WHERE key = ?", key)[0][0]
            if not self.only_recipients:
                query = "SELECT count(*), count(DISTINCT shape) FROM records WHERE key = ? AND content != 'fingerprint'"
                records, recorded = rows(query, key)[0]
                total += shapes - recorded + records
        return max(1, total)

    def meshed_alike(self, piece: Mesh, count: int) -> list[Near]:
        """Retrieve the originals that have the meshing of a piece, the best fitting first."""
        return self.index.by_landmarks(landmarks(piece))[:count]

    def wholes(self, piece: Mesh, count: int) -> list[Near]:
        """Retrieve the originals whose whole shape is most like that of a piece, the most similar first.

        Those with the nearest descriptors are each registered to the piece; the product of both distances counts.
        """
        seen = descriptors.spread(piece)
        if seen is None:
            return []
        near = self.index.by_whole(descriptors.whole(seen), _ALIKE)
        off = fit_whole(piece, [self._points(one.shape) for one in near])
        both = [one._replace(distance=one.distance * float(fit)) for one, fit in zip(near, off, strict=True)]
        return sorted(both, key=lambda one: one.distance)[:count]

    def parts(self, piece: Mesh, count: int) -> list[Near]:
        """Retrieve the originals that a piece is most likely a part of, the best fitting first."""
        local = descriptors.local(piece)
        return [] if local is None else self.fitting(piece, self.index.by_parts(local, _LIKELY))[:count]

    def fitting(self, piece: Mesh, likely: Sequence[Near]) -> list[Near]:
        """Retrieve the originals that a part fits, the best fitting first.

        Args:
            piece: the part.
            likely: originals of which a part looks like this one: a few of different shapes are tried, and then those
                that look like the ones it fits.
        """
        if not likely or not len(piece.faces):
            return []
        part = Part(piece)
        references: dict[int, Mesh] = {}
        for near in self.index.unlike(likely, _REFERENCES):
            with suppress(JaxmarkError):  # its file is missing
                references[near.shape] = self.catalogue.load(near.shape)
        poses: dict[int, list[Pose]] = {}
        for placed in part.place(references.values()):
            for shape in self.index.like([*references][placed.reference], _KIN):
                poses.setdefault(shape, []).append(placed.pose)
        off = part.fit({shape: self._points(shape) for shape in poses}, poses)
        return [Near(shape, off[shape]) for shape in sorted(off, key=off.__getitem__)]

    def _points(self, shape: int) -> Points:
        """Return the points that are kept of an original."""
        database = self.catalogue.database
        (row,) = database.rows("SELECT points FROM shapes WHERE id = ?", shape)
        if len(row["points"]) != 6 * descriptors.POINTS:
            raise JaxmarkError(f"The catalogue {database.path} is damaged: the points of a shape are not whole.")
        return np.frombuffer(row["points"], "<f2").astype(np.float64).reshape(-1, 3)

    def _compare(self, piece: Piece, depth: int, readings: int) -> Iterator[_Comparison]:
        """Compare a piece with the originals that look like it; a piece that is a whole original is no part of one."""
        known: set[int] = set()
        is_whole = False
        for by, look in (("landmarks", self.meshed_alike), ("whole", self.wholes), ("part", self.parts)):
            for number, near in enumerate([] if is_whole else look(piece.mesh, depth), 1):
                query = "SELECT o.path, s.name FROM shapes s JOIN originals o ON o.id = s.original WHERE s.id = ?"
                found = self.catalogue.database.rows(query, near.shape)
                if near.shape in known or not found:  # it may have been removed meanwhile
                    continue
                known.add(near.shape)
                match = Match(found[0]["path"], found[0]["name"], piece.name, by, number, near.distance)
                best = self._best(_Comparison(match, piece.mesh, piece.mesh, readings), near.shape)
                is_whole |= best.match.coverage >= _WHOLE
                yield best

    def _best(self, pair: _Comparison, shape: int) -> _Comparison:
        """Read a piece beside an original in all ways, and return the most significant reading."""
        best = None
        try:
            pair = pair._replace(original=self.catalogue.load(shape))
            for one in self._read(pair, shape):
                # The record that commits to the result is the one that the suspect was made with.
                if best is None or (not one.agrees, one.match.log10_p) < (not best.agrees, best.match.log10_p):
                    best = one
                if one.match.named and one.agrees:
                    break
        except JaxmarkError as error:
            pair = pair._replace(match=pair.match._replace(refused=str(error)))
        return best or pair

    def _read(self, pair: _Comparison, shape: int) -> Iterator[_Comparison]:
        """Read a piece beside an original with each key and record."""
        for name, key in self.keys.items():
            records, traced = self._held(shape, name)
            for record, recipients in traced:
                yield self._trace(pair._replace(readings=pair.readings * len(traced)), key, record, recipients)
            if self.only_recipients:
                continue
            for record in records or [None]:
                bits = self.bits if record is None else None
                marker = make_marker(pair.original, key, bits=bits, record=record)
                found, mark = alternatives(marker).read(pair.suspect, align=self.align)
                evidence = found.evidence.charged(ledger.ORIGINALS.charge("original", pair.readings))
                found = found._replace(evidence=evidence)
                match = pair.match._replace(
                    named=found.detected(self.alpha),
                    message=None if found.message is None else found.message.hex(),
                    log10_p=evidence.log10_p,
                    log10_p_uncommitted=evidence.log10_p_uncommitted,
                    key=name,
                    record=None if record is None else record.digest(),
                    coverage=found.coverage,
                    residual=_finite(found.registration.residual),
                    caveats=evidence.caveats,
                    notes=found.notes,
                )
                agrees = found.message is None or is_recorded(record, found.message, mark.choices) is not False
                yield pair._replace(match=match, pose=found.registration.pose, agrees=agrees)

    def _held(self, shape: int, key: str) -> tuple[list[Record], list[tuple[Record, list[str]]]]:
        """Return the records of messages and presence marks of an original under a key, and those of its copies.

        There is one record for each way of marking copies, with its recipients.
        """
        rows = self.catalogue.database.rows
        query = "SELECT digest, json FROM records WHERE shape = ? AND key = ? ORDER BY added DESC, digest"
        known = {row["digest"]: Record.of(_parsed(row["json"]), "in the catalogue") for row in rows(query, shape, key)}
        ways: dict[tuple[Any, ...], tuple[Record, list[str]]] = {}
        query = "SELECT recipient, record FROM copies WHERE shape = ? AND key = ? ORDER BY id"
        for row in rows(query, shape, key):
            record = known[row["record"]]
            way = record.version, record.scheme, record.bits, repr(sorted(record.parameters.items()))
            ways.setdefault(way, (record, []))[1].append(row["recipient"])
        return [one for one in known.values() if one.content != "fingerprint"], list(ways.values())

    def _trace(self, pair: _Comparison, key: Key, record: Record, recipients: list[str]) -> _Comparison:
        """Look for recipients' copies in a piece."""
        tracer = make_tracer(pair.original, key, record=record)
        mark, aligned = tracer.mark, tracer.register(pair.suspect, self.align)
        charge = ledger.ORIGINALS.charge("copy", pair.readings)
        bounds = {one.recipient: one.charged(charge).log10_p for one in tracer.read(aligned, recipients)}
        accused = tuple(name for name, log10_p in bounds.items() if log10_p <= math.log10(self.alpha))
        accused = () if mark.caveats else accused
        best = min(bounds.values(), default=0.0)
        seen = aligned.weights[mark.original.used] > 0
        match = pair.match._replace(
            named=bool(accused),
            recipient=accused[0] if accused else None,
            accused=accused,
            log10_p=best,
            log10_p_uncommitted=ledger.uncommitted(best),
            key=commitment(key),
            record=record.digest(),
            coverage=float(seen.mean()),
            residual=_finite(aligned.residual),
            caveats=mark.caveats,
        )
        return pair._replace(match=match, pose=aligned.pose)


def split(meshes: Mapping[str, Mesh]) -> list[Piece]:
    """Split a suspect: each distinct mesh, then the components of those that have several large ones."""
    distinct: dict[bytes, Piece] = {}
    for name, mesh in meshes.items():
        distinct.setdefault(geometry_hash(mesh), Piece(name, mesh, ""))
    wholes = sorted(distinct.values(), key=lambda piece: -len(piece.mesh.faces))[:_MOST_PIECES]
    found = [*wholes]
    for piece in wholes:
        parts = _components(piece.mesh)
        if len(parts) > 1:
            names = (f"{piece.name}#{number}".lstrip() for number in range(1, len(parts) + 1))
            found += [Piece(name, part, piece.name) for name, part in zip(names, parts, strict=True)]
    return found[:_MOST_PIECES]


def _components(mesh: Mesh) -> list[Mesh]:
    """Return the largest components of a surface, without small ones."""
    if not len(mesh.faces):
        return []
    welded = weld_mesh(mesh, weld(mesh.vertices))
    least = _LEAST_SHARE * area(welded)
    parts = components(welded)[:_MOST_COMPONENTS]
    return [compact(part) for part in parts if len(part.faces) >= _LEAST_FACES and area(part) >= least]


def _is_explained(piece: Mesh, pose: Pose, original: Mesh) -> bool:
    """Whether a piece lies on an original that the suspect was aligned with by a pose."""
    points = np.asarray(original.vertices, np.float64)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    spacing = float(np.median(KDTree(points).query(points[:: max(1, len(points) // 1000)], k=2)[0][:, 1]))
    posed = pose(np.asarray(piece.vertices, np.float64))
    off = KDTree(points).query(posed[:: max(1, len(posed) // 1000)])[0]
    return float(np.median(off)) <= max(_NEAR * size, spacing)


def _finite(residual: float) -> float | None:
    """Return a number that JSON has; None if nothing was covered."""
    return residual if math.isfinite(residual) else None


def _parsed(text: str) -> Any:
    """Parse the JSON of a record; None if it is damaged, which `Record.of` refuses."""
    try:
        return json.loads(text)
    except ValueError:
        return None
