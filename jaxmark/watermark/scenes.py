"""Scenes: files of several meshes, each marked on its own with one message, and what they prove together.

Keyed choices are bound to each mesh's geometry, so that the marks of different meshes are independent. Equal meshes
carry equal marks, and count once.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist

from jaxmark.alignment.alignment import Align, align
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import canonical_json
from jaxmark.watermark.everyday import AnyMarker, AnyScheme, prepare
from jaxmark.watermark.evidence import bounds as evidence
from jaxmark.watermark.marking import ALIGN_SHARES, CLAIM_SHARE, Detection, EmbedInfo, Marker, make_marker
from jaxmark.watermark.perception.budget import Limits, Visibility
from jaxmark.watermark.reading.detectors import claims
from jaxmark.watermark.record import Record, read_json
from jaxmark.watermark.schemes.scheme import DEFAULT_SCHEME, Scheme

_Numbers = Float64[np.ndarray, " numbers"]

_FORMAT, _VERSION = "jaxmark-scene", 1
_SHAPES_ALIKE = 0.1  # distance of moments below which a mesh may be another one in another pose
_PROFILE = 500  # vertices by which meshes of one connectivity are told apart
_SUM_SHARE = 0.5  # share of the probability that the sum over meshes has; the rest is that of meshes alone


@dataclass(frozen=True)
class SceneRecord:
    """The records of a file's meshes, by name; each of them reads its mesh alone, too."""

    meshes: Mapping[str, Record]

    @property
    def bits(self) -> int:
        """Size of the payload in bits."""
        return next(iter(self.meshes.values())).bits

    @property
    def told(self) -> str:
        """What all records commit to, if they commit to anything."""
        return "".join(record.told for record in self.meshes.values())

    def to_json(self) -> str:
        """The records as JSON text."""
        meshes = {name: json.loads(record.to_json()) for name, record in self.meshes.items()}
        return json.dumps({"format": _FORMAT, "version": _VERSION, "meshes": meshes}, indent=2) + "\n"

    def digest(self) -> str:
        """SHA-256 over all records, hexadecimal, which anybody can compute."""
        digests = {name: record.digest() for name, record in self.meshes.items()}
        return hashlib.sha256(b"jaxmark/scene" + canonical_json(digests)).hexdigest()


def load_record(path: str | os.PathLike[str]) -> Record | SceneRecord:
    """Read a record file, of one mesh or of several.

    Raises:
        JaxmarkError: see `Record.load`.
    """
    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        return Record.load(path)
    meshes = data.get("meshes")
    if data.get("version") != _VERSION:
        raise JaxmarkError(f"The record {path} is of version {data.get('version')}; this jaxmark reads {_VERSION}.")
    if not isinstance(meshes, dict) or not meshes:
        raise JaxmarkError(f"The record {path} is damaged: it has no meshes.")
    return SceneRecord({name: Record.of(item, f"{path}, mesh {name!r},") for name, item in meshes.items()})


class SceneInfo(NamedTuple):
    """How the meshes of a file were marked."""

    meshes: Mapping[str, EmbedInfo]  # of those that were marked, by name
    left: Mapping[str, str]  # the others, and why they were left alone
    record: SceneRecord


class SceneDetection(NamedTuple):
    """The result of reading the meshes of a file."""

    united: Detection  # of all meshes together; what belongs to one mesh is that of the mesh with most evidence
    meshes: Mapping[str, Detection]  # of each original mesh
    left: Mapping[str, str]  # the original meshes that could not be compared, and why

    def detected(self, alpha: float = 1e-6) -> bool:
        """Whether the false-positive probability is at most `alpha`; see `Detection.detected`."""
        return self.united.detected(alpha)


def embed_scene(
    meshes: Mapping[str, Mesh],
    message: bytes,
    key: bytes,
    *,
    budget: float | None = None,
    limits: Limits | None = None,
    visibility: Visibility | None = None,
    noise: float | None = None,
    scheme: AnyScheme = DEFAULT_SCHEME,
    after: Callable[[str, AnyMarker, Mesh, EmbedInfo], EmbedInfo] = lambda name, marker, marked, info: info,
) -> tuple[dict[str, Mesh], SceneInfo]:
    """Embed one message in each mesh of a file that can carry it.

    Args:
        meshes: by name, from `jaxmark.files.load_scene`.
        message: see `embed`.
        key: see `embed`.
        budget: see `embed`; relative to each mesh's own diagonal.
        limits: see `embed`.
        visibility: see `embed`.
        noise: see `embed`.
        scheme: see `embed`.
        after: is called with each mesh's name, marker, marked mesh and info; returns the info to keep, or raises a
            `JaxmarkError` if the mesh must be left alone after all.

    Returns:
        The marked meshes, and how they were marked.

    Raises:
        JaxmarkError: if no mesh can carry the message; see `embed`.
    """
    marked: dict[str, Mesh] = {}
    infos: dict[str, EmbedInfo] = {}
    left: dict[str, str] = {}
    for name, mesh in meshes.items():
        try:
            marker = prepare(mesh, key, 8 * len(message), scheme)
            result, info = marker.embed(message, budget, limits=limits, visibility=visibility, noise=noise)
            info = after(name, marker, result, info)
        except JaxmarkError as error:
            left[name] = str(error).rstrip(".")
        else:
            marked[name], infos[name] = result, info
    if not marked:
        raise JaxmarkError(f"None of the {len(meshes)} meshes can carry the mark: {_told(left)}.")
    return marked, SceneInfo(infos, left, SceneRecord({name: info.record for name, info in infos.items()}))


def detect_scene(
    suspects: Mapping[str, Mesh],
    *,
    originals: Mapping[str, Mesh],
    key: bytes,
    record: SceneRecord | None = None,
    bits: int | None = None,
    message: bytes | None = None,
    scheme: str | Scheme = DEFAULT_SCHEME,
    how: Align = "auto",
    after: Callable[[], None] = lambda: None,
) -> SceneDetection:
    """Read the meshes of a file, and unite what they prove.

    Each original mesh is compared with the suspect mesh that looks like it, see `pair`. What each mesh proves alone
    counts, and so does the weighted sum of all scores for one message; all of that is paid for.

    Args:
        suspects: meshes by name, from `jaxmark.files.load_scene`.
        originals: the unmarked meshes by name.
        key: see `detect`.
        record: the record of the file, which says which meshes were marked; by default all may have been.
        bits: see `detect`.
        message: see `detect`.
        scheme: see `detect`.
        how: see `align`.
        after: is called after each mesh.

    Raises:
        JaxmarkError: if no mesh can be compared; see `detect`.
    """
    chosen = dict(originals)
    if record is not None:
        if missing := record.meshes.keys() - originals.keys():
            raise JaxmarkError(f"The original has no mesh {min(missing)!r}, which the record says was marked.")
        chosen = {name: originals[name] for name in record.meshes}
    if bits is None and record is None and message is not None:
        bits = 8 * len(message)
    seen: dict[str, _Seen] = {}
    left: dict[str, str] = {}
    known: set[tuple[bytes, bytes]] = set()
    found = pair(chosen, suspects)
    for name, original in chosen.items():
        try:
            if name not in found:
                raise JaxmarkError("Nothing in the suspect looks like it.")
            own = None if record is None else record.meshes[name]
            marker = make_marker(original, key, bits=bits, record=own, scheme=scheme)
            if marker.choices.version == 1:
                raise JaxmarkError("A mark of version 1 is read alone, not in a scene.")
            mark = marker.original.geometry, marker.original.order
            if mark in known:
                raise JaxmarkError("It equals another mesh, and counts once.")
            aligned = align(marker.original, suspects[found[name]], how)
            # What a marker has computed to read is let go of: that of all meshes would not fit.
            seen[name] = _Seen(replace(marker), marker.detect(aligned, message))
            known.add(mark)
        except JaxmarkError as error:
            left[name] = str(error).rstrip(".")
        after()
    if not seen:
        raise JaxmarkError(f"None of the {len(chosen)} meshes could be compared: {_told(left)}.")
    return SceneDetection(_unite(seen, message), {name: one.found for name, one in seen.items()}, left)


class _Seen(NamedTuple):
    """A mesh that was read, in a pose in which the key had no part."""

    marker: Marker
    found: Detection


def _unite(seen: Mapping[str, _Seen], claimed: bytes | None) -> Detection:
    """What all meshes prove together."""
    alone = [one.found for one in seen.values()]
    best = min(alone, key=lambda one: (one.log10_p, one.message is None))
    if len(alone) == 1:
        return best
    share = (1 - _SUM_SHARE) / len(alone)
    united = best._replace(
        log10_p=evidence.share_of(best.log10_p, share),
        log10_p_undated=evidence.share_of(min(one.log10_p_undated for one in alone), share),
        log10_p_unfloored=evidence.share_of(min(one.log10_p_unfloored for one in alone), share, evidence.UNFLOORED),
        doubts=tuple(dict.fromkeys(doubt for one in alone for doubt in one.doubts)),
    )
    markers = [one.marker for one in seen.values()]
    if not markers[0].bits:
        claimed = b""
    messages = {claimed} if claimed is not None else {one.message for one in alone if one.message is not None}
    for message in messages:
        if any(8 * len(message) != marker.bits for marker in markers):
            continue
        # As for one mesh: what was fixed beforehand has nearly all of the probability, any other message the rest.
        told = [bool(marker.record and marker.record.told) for marker in markers]
        fixed = claimed is not None or (
            all(told) and all(m.record and m.record.commits_to(message, m.choices) for m in markers)
        )
        part = CLAIM_SHARE if fixed else 1 - CLAIM_SHARE if any(told) else 1.0
        part *= _SUM_SHARE * ALIGN_SHARES[best.alignment.how]
        score, bits = _summed(seen.values(), message), markers[0].bits
        unknown = 0 if fixed else bits
        log10_p = evidence.share_of(evidence.log10_p_read(score, 1.0, unknown), part)
        further = evidence.log10_p_read(score, 1.0, unknown, evidence.UNFLOORED)
        further = evidence.share_of(further, part, evidence.UNFLOORED)
        late = evidence.undated(evidence.share_of(evidence.log10_p_read(score, 1.0, bits), part))
        united = united._replace(
            log10_p_undated=min(late, united.log10_p_undated),
            log10_p_unfloored=min(further, united.log10_p_unfloored),
        )
        if log10_p < united.log10_p:
            read = message if any(one.message == message for one in alone) else None
            fitted = evidence.log10_p_fitted(score, 1.0, unknown)
            united = united._replace(message=read, log10_p=log10_p, log10_p_fitted=fitted)
    return united


def _summed(seen: Iterable[_Seen], message: bytes) -> float:
    """The weighted sum of all meshes' scores for a message, over its norm, less what rounding may add.

    A score over its norm is a sum of independent signs with factors whose squares add up to 1. So is the weighted sum
    over meshes, over the root of the sum of the squared weights, because the signs of different meshes are independent.
    Weights are the roots of the numbers of points seen; the first way of weighting points is taken: neither is a choice
    of the key.
    """
    total = square = rounding = 0.0
    for marker, found in seen:
        received = marker.receive(found.alignment)
        word = jnp.asarray(marker.codeword(message), received.observed.residual.dtype)
        score, norm = (np.asarray(values)[0] for values in claims(marker.reader, received, word))
        ratio = float(score) / float(norm) if norm > 0 else 0.0
        points = float(np.sum(found.alignment.weights > 0))
        total += math.sqrt(points) * ratio
        rounding += math.sqrt(points) * 4 * float(np.finfo(score.dtype).eps) * (1 + abs(ratio))
        square += points
    return (total - rounding) / math.sqrt(square) if square else 0.0


def pair(originals: Mapping[str, Mesh], suspects: Mapping[str, Mesh]) -> dict[str, str]:
    """Find which mesh of a suspect looks like each original mesh.

    First those of the same connectivity, then of a similar shape by its moments, or of the same name. Of several, the
    most similar shape is taken; a name counts where shapes hardly differ. A suspect's only mesh is compared with all.
    Neither key nor marks decide.

    Returns:
        Names in the suspect by names in the original, where there is one.
    """
    if len(suspects) == 1:
        return dict.fromkeys(originals, next(iter(suspects)))
    found: dict[str, str] = {}
    ours, theirs = _by_connectivity(originals), _by_connectivity(suspects)
    for connectivity, names in ours.items():
        others = theirs.get(connectivity, [])
        profiles = (
            {name: _profile(originals[name]) for name in names},
            {name: _profile(suspects[name]) for name in others},
        )
        found |= _nearest(*profiles, most=math.inf)
    left = {name: _shape(mesh) for name, mesh in originals.items() if name not in found}
    free = {name: _shape(mesh) for name, mesh in suspects.items() if name not in found.values()}
    return found | _nearest(left, free, most=_SHAPES_ALIKE)


def _by_connectivity(meshes: Mapping[str, Mesh]) -> dict[tuple[int, bytes], list[str]]:
    """The names of meshes that have the same faces on the same number of vertices."""
    groups: dict[tuple[int, bytes], list[str]] = {}
    for name, mesh in meshes.items():
        faces = np.ascontiguousarray(mesh.faces, np.int64)
        groups.setdefault((len(mesh.vertices), hashlib.sha256(faces.tobytes()).digest()), []).append(name)
    return groups


def _nearest(ours: Mapping[str, _Numbers], theirs: Mapping[str, _Numbers], most: float) -> dict[str, str]:
    """Pair what has the most similar numbers, which differ by no more than `most` unless names are equal."""
    if not ours or not theirs:
        return {}
    names, others = list(ours), list(theirs)
    off = cdist(np.stack(list(ours.values())), np.stack(list(theirs.values())), "chebyshev")
    same = np.array(names)[:, None] == np.array(others)[None, :]
    cost = np.where(same | (off <= most), np.where(same, 0.5, 1.0) * off, np.inf)
    found: dict[str, str] = {}
    taken: set[str] = set()
    for place in np.argsort(cost, axis=None, kind="stable"):
        row, column = divmod(int(place), len(others))
        if not np.isfinite(cost[row, column]) or len(found) == len(names):
            break
        if names[row] not in found and others[column] not in taken:
            found[names[row]] = others[column]
            taken.add(others[column])
    return found


def _profile(mesh: Mesh) -> _Numbers:
    """Distances of some vertices to the centre of all, in any pose and scale."""
    points = np.asarray(mesh.vertices, np.float64)
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    size = np.sqrt(np.mean(away**2))
    some = np.linspace(0, len(away) - 1, min(len(away), _PROFILE)).astype(np.int64)
    return away[some] / size if 0 < size < math.inf else np.zeros(len(some))


def _shape(mesh: Mesh) -> _Numbers:
    """Numbers that describe a surface in any pose and scale: the extents of its area, and how much area they hold."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    total = areas.sum()
    if not 0 < total < math.inf:
        return np.zeros(4)
    centres = corners.mean(axis=1)
    centres = centres - areas @ centres / total
    values = np.linalg.eigvalsh(centres.T @ (areas[:, None] * centres) / total)
    size = max(values.sum(), np.finfo(float).tiny)
    return np.append(np.sqrt(np.maximum(values, 0) / size), math.sqrt(total / size) / 10)


def _told(left: Mapping[str, str]) -> str:
    """Why meshes were left alone, the first three of them."""
    told = "; ".join(f"{name!r}: {reason}" for name, reason in list(left.items())[:3])
    return told + "; …" * (len(left) > 3)
