"""Identification of the originals, keys and recipients of a suspect, with a bound on the false-positive probability.

The originals that are most similar to the suspect are retrieved without a key. Only these are aligned and read. The
significance budget nevertheless covers every original of the catalogue, with every key, record and list of recipients.
"""

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
from scipy.spatial import KDTree

from jaxmark.alignment.result import Align
from jaxmark.catalogue import descriptors
from jaxmark.catalogue.database import Database
from jaxmark.catalogue.landmarks import landmarks
from jaxmark.catalogue.originals import meshes_of
from jaxmark.catalogue.partial_registration import Part, fit_whole
from jaxmark.catalogue.pieces import LeftOut, Piece, split
from jaxmark.catalogue.retrieval import Index, Near, state_of
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Points, Pose
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.everyday import alternatives
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.detection import check_alpha
from jaxmark.watermark.evidence.ledger import Charge
from jaxmark.watermark.markers import make_marker
from jaxmark.watermark.record import Record, is_recorded
from jaxmark.watermark.tracing.tracer import make_tracer

DEPTH = 3  # default number of originals that are read for each piece, for each way of retrieval
_ALIKE = 100  # originals to which a whole shape is fitted
_LIKELY = 2000  # originals that are retrieved as candidates for a part
_REFERENCES = 6  # candidates of different shapes by which the poses of a part are found
_KIN = 200  # originals similar to a reference to which a part is fitted
_DEEP_PIECES = 1  # pieces of a suspect that are compared with DEPTH originals; other pieces are compared with one
_WAYS = 3  # ways of retrieval
# Comparisons in vain after which a search ends, in addition to those of one piece by all ways. Each takes seconds.
_FURTHER_COMPARISONS = 4
_ENDED = (
    "the search by shape ended after {} comparisons that show no mark, with the pieces that are most similar to an"
    " original; to search one of them, save it as a file of its own"
)
_WHOLE = 0.95  # coverage from which on a piece counts as a whole original
_NEAR = 0.01  # largest distance of a piece from an original, over its size, if the original explains the piece


class Match(NamedTuple):
    """The comparison of a piece of a suspect with an original."""

    original: str  # path of the original's file
    mesh: str  # name of the original's mesh in the file; empty if it is the only one
    piece: str  # name of the suspect's piece; empty if it is the whole file
    by: str  # the way of retrieval: by "landmarks", as a "whole" or as a "part"
    rank: int  # rank among the originals that are similar to the piece, from 1
    distance: float  # distance of descriptors for wholes; else the residual, in RMS distances to the centre
    named: bool = False  # whether the probability is at most alpha
    message: str | None = None  # hexadecimal
    recipient: str | None = None
    accused: tuple[str, ...] = ()  # all recipients that are accused
    estimate: bool = False  # whether the probability is at most alpha, but an estimate, which names and accuses nobody
    estimates: tuple[str, ...] = ()  # the recipients that would be accused without the caveats
    log10_p: float = 0.0  # log10 of a bound on the probability that any original, key or recipient is named by chance
    log10_p_uncommitted: float = 0.0  # the bound if keys, originals and records may have been chosen afterwards
    key: str | None = None  # commitment to the key that was used
    record: str | None = None  # digest of the record that was used
    coverage: float = 0.0  # fraction of the original that is registered to the piece
    residual: float | None = None  # RMS residual of the registration, in diagonals
    caveats: tuple[str, ...] = ()  # reasons why the probabilities are estimates
    charges: tuple[Charge, ...] = ()  # choices that `log10_p` is charged for
    notes: tuple[str, ...] = ()
    refused: str | None = None  # the reason why the piece could not be read, with this record if one is named

    @property
    def order(self) -> tuple[bool, float, bool, float]:
        """The sort key by which likelier matches come first."""
        return not self.named, self.log10_p, self.refused is not None, self.rank


class Verdict(NamedTuple):
    """The result of identifying a suspect."""

    suspect: str  # SHA-256 of its file, hexadecimal; empty for a mesh without a file
    matches: tuple[Match, ...]  # all comparisons and all refusals, the likeliest first
    readings: int  # number of readings that could have been made, by which all probabilities are corrected
    left_out: tuple[LeftOut, ...] = ()  # pieces that were not searched

    @property
    def named(self) -> tuple[Match, ...]:
        """The matches of the originals that are named, one per original."""
        return self._likeliest(match for match in self.matches if match.named)

    @property
    def estimates(self) -> tuple[Match, ...]:
        """The matches that are estimates, which name no original, one per original."""
        return self._likeliest(match for match in self.matches if match.estimate)

    @staticmethod
    def _likeliest(matches: Iterable[Match]) -> tuple[Match, ...]:
        likeliest: dict[tuple[str, str], Match] = {}
        for match in matches:
            likeliest.setdefault((match.original, match.mesh), match)
        return tuple(likeliest.values())

    def as_json(self) -> dict[str, Any]:
        """Return the verdict as values for JSON.

        The fields at the top are those of the likeliest named match. If none is named, its figures are those of the
        match with the lowest bound, and its caveats say why that is only an estimate.
        """
        named = self.named[0] if self.named else None
        head = {name: getattr(named, name, None) for name in ("original", "mesh", "message", "recipient")}
        likeliest = named or min(self.matches, key=lambda match: match.log10_p, default=None)
        return {
            "named": named is not None,
            "estimate": named is None and bool(self.estimates),
            **head,
            "log10_p": likeliest.log10_p if likeliest else 0.0,
            "log10_p_uncommitted": likeliest.log10_p_uncommitted if likeliest else 0.0,
            "caveats": likeliest.caveats if likeliest else (),
            "readings": self.readings,
            "left_out": [pieces._asdict() for pieces in self.left_out],
            "suspect_sha256": self.suspect or None,
            "matches": [match._asdict() | {"charges": ledger.charges_as_json(match.charges)} for match in self.matches],
        }


class _Comparison(NamedTuple):
    """A piece of a suspect, an original, and the result of the comparison."""

    match: Match  # the result, after reading
    original: Mesh
    suspect: Mesh
    readings: int
    pose: Pose | None = None  # map from the suspect to the original
    agrees: bool = True  # whether the record that was used commits to the result

    @property
    def order(self) -> tuple[bool, bool, float]:
        """The sort key by which readings of one original come first: proofs, and then results that a record commits to.

        The suspect was made with such a record.
        """
        return not self.match.named, not self.agrees, self.match.log10_p

    def refused(self, reason: JaxmarkError | str, **fields: Any) -> "_Comparison":
        """Return the comparison without a result, for a reason."""
        return self._replace(match=self.match._replace(refused=str(reason), **fields))


@dataclass
class _Search:
    """The search for the originals of one piece."""

    piece: Piece
    compared: set[int] = field(default_factory=set)  # numbers of originals
    is_over: bool = False  # whether an original is named, or the pose of another piece explains this one
    is_whole: bool = False  # whether the piece covers a whole original, so that it is not compared as a part
    is_cut: bool = False  # whether comparisons were left out


@dataclass
class _Progress:
    """The state of the search for the originals of all pieces of a suspect."""

    searches: list[_Search]
    readings: int
    comparisons: int  # number of comparisons in vain after which the search ends
    matches: list[Match] = field(default_factory=list)


class _Stored(NamedTuple):
    """The stored records of an original under a key."""

    records: list[Record]  # of messages and presence marks
    ways: list[tuple[Record, list[str]]]  # one record for each way of marking copies, with its recipients
    refusals: dict[str, str]  # records that cannot be used by their digests, and the reasons


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
        catalogue: the catalogue; it may be opened for reading only.
        keys: the keys that marks may have been made with.
        alpha: largest false-positive probability at which an original is named.
        bits: payload of messages without a record, in bits; by default 64.
        depth: number of originals that are read for each piece of a suspect, for each way of retrieval.
        align: how suspects are aligned, see `detect`; other ways than "auto" are charged.
        only_recipients: whether to identify recipients' copies only.

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
            raise JaxmarkError("Reading marks needs a key; give at least one.")
        check_alpha(alpha)
        if depth < 1:
            raise JaxmarkError(f"The depth must be at least 1, got {depth}.")
        if align not in get_args(Align):
            raise JaxmarkError(f"There is no way to align {align!r}; there are {', '.join(get_args(Align))}.")
        self.catalogue, self.alpha, self.bits, self.depth = catalogue, alpha, bits, depth
        self.align: Align = align
        self.keys = {commitment(key): Key(key) for key in keys}
        self.only_recipients = only_recipients
        self._index: Index | None = None

    @property
    def index(self) -> Index:
        """The descriptors of all originals that are in the catalogue now."""
        if self._index is None or self._index.state != state_of(self.catalogue.database):
            self._index = Index(self.catalogue.database)
        return self._index

    def prepare(self) -> None:
        """Read the descriptors now; otherwise they are read with the first suspect.

        Raises:
            JaxmarkError: if the catalogue is empty or damaged.
        """
        self._index = Index(self.catalogue.database)

    def find(self, suspect: str | os.PathLike[str] | Mesh) -> Verdict:
        """Find the originals that a suspect was made from.

        Args:
            suspect: a mesh, or a file of one or several meshes; in any pose and scale, whole or in part.

        Raises:
            JaxmarkError: if the suspect cannot be read, or the catalogue is empty or damaged.
        """
        meshes = {"": suspect} if isinstance(suspect, Mesh) else meshes_of(suspect).meshes
        digest = "" if isinstance(suspect, Mesh) else file_hash(suspect)
        pieces, left_out = split(meshes)
        # A file of many pieces that resemble no original must not cost much more than a file of one such piece.
        most_in_vain = _WAYS * self.depth + _FURTHER_COMPARISONS
        progress = _Progress([_Search(piece) for piece in pieces], len(pieces) * self._readings(), most_in_vain)
        self._search_by_connectivity(progress)
        self._search_by_shape(progress)
        cut = [search.piece for search in progress.searches if search.is_cut and not search.is_over]
        left_out += LeftOut.of(cut, _ENDED.format(most_in_vain))
        matches = sorted(progress.matches, key=lambda match: match.order)
        return Verdict(digest, tuple(matches), progress.readings, left_out)

    def _readings(self) -> int:
        """Count all possible readings of a piece, each of which could have named an original."""
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
        """Retrieve the originals that have the same connectivity as a piece, the best fit first."""
        return self.index.by_landmarks(landmarks(piece))[:count]

    def wholes(self, piece: Mesh, count: int) -> list[Near]:
        """Retrieve the originals whose whole shape is most similar to that of a piece, the most similar first.

        The originals with the nearest descriptors are registered to the piece. They are sorted by the product of the
        distance of descriptors and the distance after registration.
        """
        points = descriptors.spread(piece)
        if points is None:
            return []
        nearest = self.index.by_whole(descriptors.whole(points), _ALIKE)
        fits = fit_whole(piece, [self._points(near.shape) for near in nearest])
        both = [near._replace(distance=near.distance * float(fit)) for near, fit in zip(nearest, fits, strict=True)]
        return sorted(both, key=lambda near: near.distance)[:count]

    def parts(self, piece: Mesh, count: int) -> list[Near]:
        """Retrieve the originals that a piece is most likely a part of, the best fit first."""
        local = descriptors.local(piece)
        return [] if local is None else self.fitting(piece, self.index.by_parts(local, _LIKELY))[:count]

    def fitting(self, piece: Mesh, likely: Sequence[Near]) -> list[Near]:
        """Retrieve the originals that a part fits, the best fit first.

        Args:
            piece: the part.
            likely: candidates. The part is registered to some candidates of different shapes first, and then to the
                originals that are similar to those that it fits best.
        """
        if not likely or not len(piece.faces):
            return []
        part = Part(piece)
        references: dict[int, Mesh] = {}
        for near in self.index.unlike(likely, _REFERENCES):
            with suppress(JaxmarkError):  # raised if the original's file is missing
                references[near.shape] = self.catalogue.load(near.shape)
        poses: dict[int, list[Pose]] = {}
        for placed in part.place(references.values()):
            for shape in self.index.like([*references][placed.reference], _KIN):
                poses.setdefault(shape, []).append(placed.pose)
        distances = part.fit({shape: self._points(shape) for shape in poses}, poses)
        return [Near(shape, distances[shape]) for shape in sorted(distances, key=distances.__getitem__)]

    def _points(self, shape: int) -> Points:
        """Return the stored points of an original."""
        database = self.catalogue.database
        (row,) = database.rows("SELECT points FROM shapes WHERE id = ?", shape)
        if len(row["points"]) != 6 * descriptors.POINTS:
            raise JaxmarkError(
                f"The catalogue {database.path} is damaged: the points of a mesh are incomplete; use a backup, or"
                " import an export into a new catalogue."
            )
        return np.frombuffer(row["points"], "<f2").astype(np.float64).reshape(-1, 3)

    def _search_by_connectivity(self, progress: _Progress) -> None:
        """Compare pieces with originals of the same connectivity, meshes first, and among these the best fits first."""
        alike = [(search, self.meshed_alike(search.piece.mesh, self.depth)) for search in progress.searches]
        alike = [(search, nearest) for search, nearest in alike if nearest]
        alike.sort(key=lambda pair: (bool(pair[0].piece.within), pair[1][0].distance))
        for number, (search, nearest) in enumerate(alike):
            self._compare(progress, search, "landmarks", nearest[: self._depth(number)])

    def _search_by_shape(self, progress: _Progress) -> None:
        """Compare pieces with similar originals, and with those that they may be parts of, the likeliest pieces first.

        This finds remeshed copies, but takes much longer than by connectivity.
        """
        searches = [search for search in progress.searches if not search.is_over and not search.is_whole]
        searches.sort(key=lambda search: self._unlikeness(search.piece.mesh))
        for number, search in enumerate(searches):
            for by, look in (("whole", self.wholes), ("part", self.parts)):
                search.is_cut |= progress.comparisons <= 0
                if not (search.is_over or search.is_whole or search.is_cut):
                    progress.comparisons -= by == "part"  # to find the poses of a part takes as long as a comparison
                    self._compare(progress, search, by, look(search.piece.mesh, self._depth(number)))

    def _depth(self, number: int) -> int:
        """Return the number of originals that a piece is compared with, by its place among the likeliest pieces."""
        return self.depth if number < _DEEP_PIECES else 1

    def _unlikeness(self, piece: Mesh) -> float:
        """Return the distance of a piece from the most similar original, by descriptors of whole shapes."""
        points = descriptors.spread(piece)
        return math.inf if points is None else self.index.by_whole(descriptors.whole(points), 1)[0].distance

    def _compare(self, progress: _Progress, search: _Search, by: str, nearest: Sequence[Near]) -> None:
        """Compare a piece with some originals, until one is named."""
        piece = search.piece
        for number, near in enumerate(nearest, 1):
            query = "SELECT o.path, s.name FROM shapes s JOIN originals o ON o.id = s.original WHERE s.id = ?"
            rows = self.catalogue.database.rows(query, near.shape)
            if near.shape in search.compared or not rows:  # the original may have been removed meanwhile
                continue
            search.is_cut |= progress.comparisons <= 0
            if search.is_over or search.is_cut:
                return
            search.compared.add(near.shape)
            match = Match(rows[0]["path"], rows[0]["name"], piece.name, by, number, near.distance)
            compared = self._best(_Comparison(match, piece.mesh, piece.mesh, progress.readings), near.shape)
            progress.matches += [pair.match for pair in compared]
            progress.comparisons -= _is_in_vain(compared)
            search.is_whole |= any(pair.match.coverage >= _WHOLE for pair in compared)
            for pair in compared:
                if pair.match.named and pair.pose is not None:
                    search.is_over = True
                    for inside in progress.searches:
                        if inside.piece.within == piece.name and _is_explained(
                            inside.piece.mesh, pair.pose, pair.original
                        ):
                            inside.is_over = True

    def _best(self, pair: _Comparison, shape: int) -> list[_Comparison]:
        """Read a piece with an original in all ways; returns all refusals, and then the most significant reading.

        A refusal ends one reading only: otherwise, a record that anybody can forge would hide all marks of an original.
        """
        try:
            pair = pair._replace(original=self.catalogue.load(shape))
        except JaxmarkError as error:
            return [pair.refused(error)]
        refusals, best = [], None
        for reading in self._read(pair, shape):
            if reading.match.refused is not None:
                refusals.append(reading)
                continue
            if best is None or reading.order < best.order:
                best = reading
            if reading.match.named and reading.agrees:
                break
        return [*refusals, best] if best is not None else refusals or [pair]

    def _read(self, pair: _Comparison, shape: int) -> Iterator[_Comparison]:
        """Read a piece with an original, by each key and record; each reading that is refused is yielded as well."""
        for name, key in self.keys.items():
            stored = self._stored(shape, key)
            for digest, reason in stored.refusals.items():
                yield pair.refused(reason, key=name, record=digest)
            readings: list[tuple[Record | None, Callable[[], _Comparison]]] = []
            traced = pair._replace(readings=pair.readings * len(stored.ways))
            readings += [(record, partial(self._trace, traced, key, record, names)) for record, names in stored.ways]
            # Without any usable record, the original is read as if it had none. This is one reading, and at least one
            # was counted for its records.
            untraced = [] if self.only_recipients else stored.records or [None]
            readings += [(record, partial(self._detect, pair, key, record)) for record in untraced]
            for record, read in readings:
                try:
                    yield read()
                except JaxmarkError as error:
                    yield pair.refused(error, key=name, record=None if record is None else record.digest())

    def _stored(self, shape: int, key: Key) -> _Stored:
        """Return the stored records of an original under a key, without those that were edited or are damaged."""
        rows, name = self.catalogue.database.rows, commitment(key)
        records: dict[str, Record] = {}
        refusals: dict[str, str] = {}
        query = "SELECT digest, json FROM records WHERE shape = ? AND key = ? ORDER BY added DESC, digest"
        for row in rows(query, shape, name):
            try:
                record = Record.of(_parsed(row["json"]), "in the catalogue")
                record.check(record.content, key)
                records[row["digest"]] = record
            except JaxmarkError as error:
                refusals[row["digest"]] = str(error)
        ways: dict[tuple[Any, ...], tuple[Record, list[str]]] = {}
        query = "SELECT recipient, record FROM copies WHERE shape = ? AND key = ? ORDER BY id"
        for row in rows(query, shape, name):
            record = records.get(row["record"])
            if record is None:
                belongs = f"It is the record of the copy for {row['recipient']}, but of another original or key."
                refusals.setdefault(row["record"], belongs)
                continue
            way = record.version, record.scheme, record.bits, repr(sorted(record.parameters.items()))
            ways.setdefault(way, (record, []))[1].append(row["recipient"])
        messages = [record for record in records.values() if record.content != "fingerprint"]
        return _Stored(messages, list(ways.values()), refusals)

    def _detect(self, pair: _Comparison, key: Key, record: Record | None) -> _Comparison:
        """Read a message or a presence mark in a piece."""
        bits = self.bits if record is None else None
        marker = make_marker(pair.original, key, bits=bits, record=record)
        detection, mark = alternatives(marker).read(pair.suspect, align=self.align)
        evidence = detection.evidence.charged(ledger.ORIGINALS.charge("original", pair.readings))
        detection = detection._replace(evidence=evidence)
        message, registration = detection.message, detection.registration
        match = pair.match._replace(
            named=detection.detected(self.alpha),
            estimate=bool(evidence.caveats) and detection.detected(self.alpha, allow_estimate=True),
            message=None if message is None else message.hex(),
            log10_p=evidence.log10_p,
            log10_p_uncommitted=evidence.log10_p_uncommitted,
            key=commitment(key),
            record=None if record is None else record.digest(),
            coverage=detection.coverage,
            residual=_finite(registration.residual),
            caveats=evidence.caveats,
            charges=evidence.charges,
            notes=detection.notes,
        )
        agrees = message is None or is_recorded(record, message, mark.choices) is not False
        return pair._replace(match=match, pose=registration.pose, agrees=agrees)

    def _trace(self, pair: _Comparison, key: Key, record: Record, recipients: list[str]) -> _Comparison:
        """Test a piece for the copies of recipients."""
        tracer = make_tracer(pair.original, key, record=record)
        mark, aligned = tracer.mark, tracer.register(pair.suspect, self.align)
        charge = ledger.ORIGINALS.charge("copy", pair.readings)
        tested = [entry.charged(charge) for entry in tracer.rank(aligned, recipients)]
        likely = tuple(entry.recipient for entry in tested if entry.log10_p <= math.log10(self.alpha))
        accused, estimates = ((), likely) if mark.caveats else (likely, ())
        likeliest = min(tested, key=lambda entry: entry.log10_p, default=None)
        best = likeliest.log10_p if likeliest else 0.0
        covered = aligned.weights[mark.original.used] > 0
        match = pair.match._replace(
            named=bool(accused),
            recipient=accused[0] if accused else None,
            accused=accused,
            estimate=bool(estimates),
            estimates=estimates,
            log10_p=best,
            log10_p_uncommitted=ledger.uncommitted(best),
            key=commitment(key),
            record=record.digest(),
            coverage=float(covered.mean()),
            residual=_finite(aligned.residual),
            caveats=mark.caveats,
            charges=likeliest.charges if likeliest else (),
        )
        return pair._replace(match=match, pose=aligned.pose)


def _is_in_vain(compared: Sequence[_Comparison]) -> bool:
    """Whether a comparison shows no mark, although it took long: the piece was not aligned by its connectivity."""
    matches = [pair.match for pair in compared]
    if any(match.named or match.estimate for match in matches):
        return False
    return any(match.by != "landmarks" for match in matches) or all(match.refused is not None for match in matches)


def _is_explained(piece: Mesh, pose: Pose, original: Mesh) -> bool:
    """Whether a piece, in the pose of the suspect, coincides with the original."""
    points = np.asarray(original.vertices, np.float64)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    spacing = float(np.median(KDTree(points).query(points[:: max(1, len(points) // 1000)], k=2)[0][:, 1]))
    posed = pose(np.asarray(piece.vertices, np.float64))
    distance = KDTree(points).query(posed[:: max(1, len(posed) // 1000)])[0]
    return float(np.median(distance)) <= max(_NEAR * size, spacing)


def _finite(residual: float) -> float | None:
    """Return a finite residual, or None, because JSON has no infinity."""
    return residual if math.isfinite(residual) else None


def _parsed(text: str) -> Any:
    """Parse the JSON of a record; returns None if it is damaged, so that `Record.of` refuses it."""
    try:
        return json.loads(text)
    except ValueError:
        return None
