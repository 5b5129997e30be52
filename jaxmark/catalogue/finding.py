"""Find which originals a suspect was made of, under which keys and for whom, and how surely.

The originals that look most like the suspect are found without any key. Only these are aligned and read, but all are
paid for: every original of the catalogue with every key, record and list of recipients that could have been named.
"""

import json
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np

from jaxmark.alignment.alignment import Align
from jaxmark.catalogue import descriptors
from jaxmark.catalogue.catalogue import Catalogue
from jaxmark.catalogue.fitting import Part, fit_whole
from jaxmark.catalogue.landmarks import landmarks
from jaxmark.catalogue.originals import file_hash, meshes_of
from jaxmark.catalogue.pieces import Piece, is_explained, split
from jaxmark.catalogue.search import Index, Near, state_of
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Points, Pose
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.everyday import alternatives
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.record import Record, is_recorded
from jaxmark.watermark.tracing.tracer import make_tracer

_ALIKE = 100  # originals that a whole is fitted to
_LIKELY = 2000  # originals of which a part may look like a piece
_REFERENCES = 6  # of these, of different shapes, by which its pose is found
_KIN = 200  # originals like a reference that a part is fitted to
_DEEP_PIECES = 3  # of a suspect; of all others, the likeliest original alone is looked at
_WHOLE = 0.95  # share of an original from which on a piece is taken for all of it
DEPTH = 3  # originals that are aligned and read for each piece, for each way of finding them


@dataclass(frozen=True)
class Match:
    """An original that a piece of a suspect was compared with."""

    original: str  # path of its file
    mesh: str  # name of its mesh in the file; empty if it is the only one
    piece: str  # name of the suspect's piece; empty if it is the whole file
    by: str  # how it was found: by its "landmarks", as a "whole" or as a "part"
    rank: int  # among the originals that look like the piece, from 1
    distance: float  # of descriptors of wholes; what landmarks or parts leave, in mean distances to the centre
    named: bool = False  # whether the probability is at most alpha
    message: str | None = None  # hexadecimal
    recipient: str | None = None
    accused: tuple[str, ...] = ()  # all recipients who are
    log10_p: float = 0.0  # log10 of a bound on the probability of any such naming, of all that could have been named
    log10_p_uncommitted: float = 0.0  # the same if nothing fixes keys, originals and records beforehand
    key: str | None = None  # commitment to the key that was read with
    record: str | None = None  # digest of the record
    coverage: float = 0.0  # share of the original that the piece shows
    residual: float | None = None  # distance that the alignment leaves, in diagonals
    caveats: tuple[str, ...] = ()  # why the probabilities are estimates
    notes: tuple[str, ...] = ()
    refused: str | None = None  # why it could not be read

    @property
    def order(self) -> tuple[bool, float, bool, float]:
        """What is more likely comes first."""
        return not self.named, self.log10_p, self.refused is not None, self.rank


@dataclass(frozen=True)
class Verdict:
    """What was found out about a suspect."""

    suspect: str  # SHA-256 of its file, hexadecimal; empty for a mesh that is no file
    matches: tuple[Match, ...]  # what was compared, the likeliest first
    tried: int  # readings that could have been made, for which all probabilities pay

    @property
    def named(self) -> tuple[Match, ...]:
        """The originals that are named, each once."""
        found: dict[tuple[str, str], Match] = {}
        for match in self.matches:
            if match.named:
                found.setdefault((match.original, match.mesh), match)
        return tuple(found.values())

    def as_json(self) -> dict[str, Any]:
        """The verdict as values for JSON; its head is the likeliest match, if any is named."""
        best = self.named[0] if self.named else None
        head = {name: getattr(best, name, None) for name in ("original", "mesh", "message", "recipient")}
        figures = {name: min((getattr(one, name) for one in self.matches), default=0.0) for name in _FIGURES}
        return {
            "named": best is not None,
            **head,
            **figures,
            "tried": self.tried,
            "suspect_sha256": self.suspect or None,
            "matches": [asdict(match) for match in self.matches],
        }


_FIGURES = ("log10_p", "log10_p_uncommitted")


class _Held(NamedTuple):
    """What the catalogue holds of an original under a key."""

    records: list[Record]  # of messages and presence marks
    traced: list[tuple[Record, list[str]]]  # of copies: a record for each way of marking, and its recipients


class Finder:
    """Finds originals of one catalogue for many suspects; keeps the descriptors in memory.

    Args:
        catalogue: may be opened for reading only.
        keys: the keys that marks may have been made with.
        alpha: largest false-positive probability at which an original is named.
        bits: payload of messages without a record; by default 64.
        depth: how many originals are aligned and read for each piece of a suspect, for each way of finding them.
        align: how suspects are aligned, see `detect`; other ways than "auto" are charged.
        only_recipients: whether to look for recipients' copies only.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        keys: Sequence[bytes],
        *,
        alpha: float = 1e-6,
        bits: int | None = None,
        depth: int = DEPTH,
        align: Align = "auto",
        only_recipients: bool = False,
    ) -> None:
        """Check what is asked for.

        Raises:
            JaxmarkError: if there is no key, or a number is out of range.
        """
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
        """Read the descriptors now, not when the first suspect comes.

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
        tried = len(pieces) * self._readings()
        matches: list[Match] = []
        explained: set[str] = set()
        for number, piece in enumerate(pieces):
            if piece.name in explained:
                continue
            depth = self.depth if number < _DEEP_PIECES else 1
            for match, pose, original in self._compare(piece, depth, tried):
                matches.append(match)
                if match.named and pose is not None:
                    inside = [one for one in pieces if one.within == piece.name]
                    explained |= {one.name for one in inside if is_explained(one.mesh, pose, original)}
                    break
        return Verdict(digest, tuple(sorted(matches, key=lambda match: match.order)), tried)

    def _readings(self) -> int:
        """How many readings of a piece are possible, of which any could have named somebody."""
        (row,) = self.catalogue.database.rows("SELECT count(*) AS shapes FROM shapes")
        total = 0
        for key in self.keys:
            records = "SELECT count(*) AS count, count(DISTINCT shape) AS shapes FROM records WHERE key = ?"
            (told,) = self.catalogue.database.rows(f"{records} AND content != 'fingerprint'", key)
            (traced,) = self.catalogue.database.rows("SELECT count(DISTINCT shape) FROM copies WHERE key = ?", key)
            total += traced[0]
            if not self.only_recipients:
                total += row["shapes"] - told["shapes"] + told["count"]
        return max(1, total)

    def meshed_alike(self, piece: Mesh, count: int) -> list[Near]:
        """The originals that have the meshing of a piece, that which it fits best first."""
        return self.index.by_landmarks(landmarks(piece))[:count]

    def wholes(self, piece: Mesh, count: int) -> list[Near]:
        """The originals whose whole shape is most like that of a piece, the most similar first.

        Of those with the nearest descriptors, each is brought onto the piece; the product of both distances counts.
        """
        seen = descriptors.spread(piece)
        if seen is None:
            return []
        near = self.index.by_whole(descriptors.whole(seen), _ALIKE)
        off = fit_whole(piece, [self._points(one.shape) for one in near])
        both = [one._replace(distance=one.distance * float(fit)) for one, fit in zip(near, off, strict=True)]
        return sorted(both, key=lambda one: one.distance)[:count]

    def parts(self, piece: Mesh, count: int) -> list[Near]:
        """The originals that a piece is most likely a part of, that which it fits best first."""
        local = descriptors.local(piece)
        return [] if local is None else self.fitting(piece, self.index.by_parts(local, _LIKELY))[:count]

    def fitting(self, piece: Mesh, likely: Sequence[Near]) -> list[Near]:
        """The originals that a part fits, that which it fits best first.

        Args:
            piece: the part.
            likely: originals of which a part looks like this one: a few of different shapes are tried, and then those
                that look like the ones it fits.
        """
        if not likely or not len(piece.faces):
            return []
        part = Part(piece)
        references, known = [], []
        for near in self.index.unlike(likely, _REFERENCES):
            with suppress(JaxmarkError):  # its file is missing
                references.append(self.catalogue.load(near.shape))
                known.append(near.shape)
        poses: dict[int, list[Pose]] = {}
        for placed in part.place(references):
            for shape in self.index.like(known[placed.reference], _KIN):
                poses.setdefault(shape, []).append(placed.pose)
        off = part.fit({shape: self._points(shape) for shape in poses}, poses)
        return [Near(shape, off[shape]) for shape in sorted(off, key=off.__getitem__)]

    def _points(self, shape: int) -> Points:
        """The points that are kept of an original."""
        (row,) = self.catalogue.database.rows("SELECT points FROM shapes WHERE id = ?", shape)
        if len(row["points"]) != 6 * descriptors.POINTS:
            raise JaxmarkError(f"The catalogue {self.catalogue.path} is damaged: the points of a shape are not whole.")
        return np.frombuffer(row["points"], "<f2").astype(np.float64).reshape(-1, 3)

    def _compare(self, piece: Piece, depth: int, tried: int) -> Iterator[tuple[Match, Pose | None, Mesh]]:
        """Compare a piece with the originals that look like it: the match, the pose, and the original.

        What lies on a whole original is no part of another.
        """
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
                match, pose, original = self._best(match, near.shape, piece.mesh, tried)
                is_whole |= match.coverage >= _WHOLE
                yield match, pose, original

    def _best(self, match: Match, shape: int, suspect: Mesh, tried: int) -> tuple[Match, Pose | None, Mesh]:
        """The reading of a piece beside an original that proves most, the pose, and the original."""
        original, best, pose, least = suspect, match, None, None
        try:
            original = self.catalogue.load(shape)
            for one, where, of_record in self._read(match, shape, original, suspect, tried):
                # The record that commits to what was read is the one that the suspect was made with.
                if least is None or (not of_record, one.log10_p) < least:
                    best, pose, least = one, where, (not of_record, one.log10_p)
                if one.named and of_record:
                    break
        except JaxmarkError as error:
            if pose is None:
                best = replace(match, refused=str(error))
        return best, pose, original

    def _read(
        self, match: Match, shape: int, original: Mesh, suspect: Mesh, tried: int
    ) -> Iterator[tuple[Match, Pose, bool]]:
        """Read a piece beside an original with each key and record: the match, the pose, and whether they agree."""
        for name, key in self.keys.items():
            held = self._held(shape, name)
            for record, recipients in held.traced:
                yield *self._trace(match, key, record, recipients, original, suspect, tried * len(held.traced)), True
            if self.only_recipients:
                continue
            for record in held.records or [None]:
                bits = self.bits if record is None else None
                found, mark = alternatives(original, key, bits=bits, record=record).read(suspect, align=self.align)
                evidence = found.evidence.charged(ledger.ORIGINALS.charge("original", tried))
                found = found._replace(evidence=evidence)
                agrees = found.message is None or is_recorded(record, found.message, mark.choices) is not False
                yield (
                    replace(
                        match,
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
                    ),
                    found.registration.pose,
                    agrees,
                )

    def _held(self, shape: int, key: str) -> _Held:
        """The records and recipients of an original under a key."""
        rows = self.catalogue.database.rows(
            "SELECT digest, content, json FROM records WHERE shape = ? AND key = ? ORDER BY added DESC, digest",
            shape,
            key,
        )
        known = {row["digest"]: Record.of(_parsed(row["json"]), "in the catalogue") for row in rows}
        ways: dict[tuple[Any, ...], tuple[Record, list[str]]] = {}
        for row in self.catalogue.database.rows(
            "SELECT recipient, record FROM copies WHERE shape = ? AND key = ? ORDER BY id", shape, key
        ):
            record = known[row["record"]]
            way = record.version, record.scheme, record.bits, repr(sorted(record.parameters.items()))
            ways.setdefault(way, (record, []))[1].append(row["recipient"])
        return _Held([one for one in known.values() if one.content != "fingerprint"], list(ways.values()))

    def _trace(
        self,
        match: Match,
        key: Key,
        record: Record,
        recipients: list[str],
        original: Mesh,
        suspect: Mesh,
        tried: int,
    ) -> tuple[Match, Pose]:
        """Look for recipients' copies in a piece."""
        tracer = make_tracer(original, key, record=record)
        mark, aligned = tracer.mark, tracer.register(suspect, self.align)
        charge = ledger.ORIGINALS.charge("copy", tried)
        bounds = {one.recipient: one.charged(charge).log10_p for one in tracer.read(aligned, recipients)}
        accused = tuple(name for name, log10_p in bounds.items() if log10_p <= math.log10(self.alpha))
        accused = () if mark.caveats else accused
        best = min(bounds.values(), default=0.0)
        seen = aligned.weights[mark.original.used] > 0
        return (
            replace(
                match,
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
            ),
            aligned.pose,
        )


def _finite(residual: float) -> float | None:
    """A number that JSON has; None where nothing was seen."""
    return residual if math.isfinite(residual) else None


def _parsed(text: str) -> Any:
    """The JSON of a record; None if it is damaged, which `Record.of` refuses."""
    try:
        return json.loads(text)
    except ValueError:
        return None
