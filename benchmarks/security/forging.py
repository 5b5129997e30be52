"""Measure what the owner of a key can forge: evidence from suspects that are independent of the key.

For suspects without the owner's mark, the owner chooses afterwards what should have been fixed before:

  strengths  a profile of 64 and more bands is fitted to score and norm by non-negative least squares, with the chips of
             an honest record; the record is then made again with the fitted profile
  grinding   the last digits of the profile's last entry are varied; each variation gives new chips
  edited     the presented original is edited: points are moved against the mark, or so that the imprint no longer
             recognises them; the suspects are the original itself, and the original with noise
  message    the message is the one that decodes best, whatever its tag
  scenes     of many originals, those are united that agree with the suspect: variants of one mesh, without a record, or
             meshes of an honest record, picked by name or by damaging the others
  records    fields of a scene's record are forged, and the record is sealed and timestamped as it is

The output has log10 p as `jaxmark.detect` prints it, committed and uncommitted; the lowest over keys and suspects, if
there are several. The exit status is 1 if chance does not explain a figure: if it is lower, by two orders of magnitude,
than the least of that many tries. The search for the message stops before its tag, which would take 2^28 hashes; it is
judged by the figure that would be printed.

    python benchmarks/security/forging.py MESH [--strengths] [--grinding] [--edited] [--message] [--scenes] [--records]
        [--keys N] [--tries N] [--bands N ...] [--originals N]

Without the flag of a section, all sections are run.
"""

import argparse
import dataclasses
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.result import Alignment
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.chebyshev import band_components
from jaxmark.spectral.laplacian import per_row
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.carriers import make_chips
from jaxmark.watermark.coding import polar
from jaxmark.watermark.coding.keys import bind
from jaxmark.watermark.coding.message import TAG_BITS, encode
from jaxmark.watermark.everyday import detect_scene
from jaxmark.watermark.evidence import bounds, ledger
from jaxmark.watermark.evidence.detection import Detection
from jaxmark.watermark.evidence.ledger import Charge, figure, uncommitted
from jaxmark.watermark.markers import NonBlindMarker
from jaxmark.watermark.nonblind import claims_of as claims_of_mark
from jaxmark.watermark.record import Record, SceneRecord, commit, load_record, make_commitment
from jaxmark.watermark.schemes.keyed import KeyedScheme
from jaxmark.watermark.schemes.registry import parameters_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.marks import BUDGET, MESSAGE, write
from common.tables import Row, say, table

SUSPECTS = {
    "noise 0.1 %": ("noise", 0.001),
    "smoothed": ("smoothing", 10),
    "quantised": ("quantisation", 10),
    "remeshed": ("midpoint", 1),
}
STEPS = 300  # of projected gradients, which choose the key
LEAST = 1e-6  # share of each band in the fit, over the largest: a band at 0 would change what is projected off
SLACK = 2.0  # orders of magnitude below what so many tries explain
SHARES = (0.1, 0.25, 0.4, 0.49, 1.0)  # of the original's points, which are edited
FACTORS = (0.01, 0.5, 1.0, 2.0)  # of the mark's displacement, by which points are moved against it
GRID_STEPS = 20  # by which points are moved that the imprint shall not recognise
NOISE = 0.0005
PAYLOADS = (64, 128, 256)
VARIANT, RECORDED = 1e-4, 150  # noise of the variants of a mesh, and number of meshes in a scene's record

Checks = dict[str, bool]  # whether chance explains the figures of each kind


class Fitted(NamedTuple):
    """The profile that the owner would choose, and what its claim would be without a record that forbids it."""

    key: int  # number of the key under which it is best
    profile: tuple[float, ...]
    log10_p: float
    honest: float  # the lowest of all keys with equal strengths


def key_of(number: int) -> jm.Key:
    return jm.Key(bytes(16) + number.to_bytes(16, "big"))


def suspects(mesh: Mesh) -> dict[str, Mesh]:
    """Meshes that know nothing of the keys tried."""
    rival = jm.make_marker(mesh, jm.Key(bytes([200] * 32)))
    others = {name: jm.attack(mesh, *how, seed=1) for name, how in SUSPECTS.items()}
    return {**others, "a rival's mark": write(rival, MESSAGE, BUDGET)}


def flat(bands: int) -> KeyedScheme:
    """Any strengths in all bands, which the owner then chooses."""
    return KeyedScheme(bands=bands, profile=(1.0,) * bands)


def signs(marker: NonBlindMarker) -> np.ndarray:
    """The signs of the marker's codeword, as they are spread over the points."""
    carrier: Any = marker.carrier  # a keyed one
    return np.asarray(carrier.spread(jnp.asarray(marker.codeword(MESSAGE), jnp.float32)), np.float64).ravel()


def shares(marker: NonBlindMarker, aligned: Alignment) -> Iterator[np.ndarray]:
    """What each band adds to the vector that the signs multiply, `[bands, chips]`, for each way of weighing."""
    reader: Any = marker.reader
    for way in reader.ways(marker.receive(aligned)):
        host = reader.carrier.host
        mass = per_row(host.operator.degree, way.residual)
        mass = jnp.where(mass > 0, mass, 1)
        each = mass * band_components(host.operator, host.coefficients, matmul(way.residual, way.axes) / mass)
        yield np.asarray((way.gain / way.power)[:, None, None] * each, np.float64).reshape(len(way.power), -1)


def roughly(products: np.ndarray, along: np.ndarray) -> np.ndarray:
    """About the best score over norm that strengths can reach, for each column of scores, by projected gradients."""
    scale = np.sqrt(np.diag(products)) + 1e-300
    unit, along = products / np.outer(scale, scale), along / scale[:, None]
    step = 1 / np.linalg.eigvalsh(unit)[-1]
    found = ahead = np.zeros_like(along)
    for turn in range(STEPS):  # Nesterov's, with the positive part
        fresh = np.maximum(ahead + step * (along - unit @ ahead), 0)
        found, ahead = fresh, fresh + turn / (turn + 3) * (fresh - found)
    return np.sum(found * along, axis=0) / np.sqrt(np.sum(found * (unit @ found), axis=0) + 1e-300)


def fit(products: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Strengths of most score over norm, by non-negative least squares."""
    scale = np.sqrt(np.diag(products))
    scale = np.maximum(scale, 1e-9 * scale.max())
    values, vectors = np.linalg.eigh(products / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 1e-9 * values[-1]))
    target = (vectors.T @ (along / scale)) / root
    found = nnls(root[:, None] * vectors.T, target, maxiter=30 * len(values))[0]
    found = np.maximum(found, LEAST * found.max()) / scale if found.any() else np.ones(len(found))
    return found / found.max()


def fitted(ways: Sequence[np.ndarray], signs: np.ndarray, charge: Charge) -> Fitted:
    """The best fit to either way of weighing under any of the keys, as a claim by both ways."""
    parts = [(each @ each.T, each @ signs.T) for each in ways]
    hopes = [roughly(*part) for part in parts]
    way, key = np.unravel_index(np.argmax(hopes), (len(parts), len(signs)))
    profile = fit(parts[way][0], parts[way][1][:, key])
    every = np.array(
        [[claims_of(part, chosen, charge) for part in parts] for chosen in (profile, np.ones_like(profile))]
    )
    fits, honest = every.min(axis=1) + math.log10(len(parts))
    return Fitted(int(key), tuple(profile.tolist()), min(0.0, fits[key]), min(0.0, honest.min()))


def claims_of(part: tuple[np.ndarray, np.ndarray], profile: np.ndarray, charge: Charge) -> np.ndarray:
    """log10 p of a claim under each key by one way of weighing, with these strengths."""
    products, along = part
    norm = math.sqrt(profile @ products @ profile)
    return np.array([figure(bounds.log10_p_score(score, norm), [charge]) for score in profile @ along])


def record_of(marker: NonBlindMarker) -> Record:
    """The record that the owner would have of this mark."""
    return marker.write(marker.codeword(MESSAGE), BUDGET, content=MESSAGE)[1].record


def remade(record: Record, key: jm.Key, mesh: Mesh, profile: Sequence[float]) -> Record:
    """The owner's record with another profile, whole in every other respect."""
    parameters = {**record.parameters, "profile": tuple(profile)}
    fresh = dataclasses.replace(record, parameters=parameters, message_commitment="").sealed(key)
    told = commit(MESSAGE, jm.make_marker(mesh, key, record=fresh).choices)
    return dataclasses.replace(fresh, message_commitment=told).sealed(key)


def strengths(mesh: Mesh, seen: dict[str, Mesh], keys: int, bands: int) -> Row:
    """Fit a profile to each suspect under each key, and read the best with it as `detect` does."""
    scheme = flat(bands)
    try:
        markers = [jm.make_marker(mesh, key_of(number), scheme=scheme) for number in range(keys)]
    except jm.JaxmarkError as refusal:
        return {"bands": bands, "honest": f"refused: {refusal}"}
    original, chosen = markers[0].original, np.array([signs(marker) for marker in markers])
    honest, hoped, printed, late = [], [], [], []
    for name, suspect in seen.items():
        aligned = align(original, suspect)
        best = fitted(list(shares(markers[0], aligned)), chosen, ledger.ALIGNMENT.charge(aligned.align))
        honest.append(best.honest)
        hoped.append(best.log10_p)
        key, profile = key_of(best.key), best.profile
        forged = jm.make_marker(mesh, key, record=remade(record_of(markers[best.key]), key, mesh, profile))
        found = forged.read(aligned, MESSAGE)
        printed.append(found.log10_p)
        late.append(found.evidence.log10_p_uncommitted)
        said = f"{hoped[-1]:.1f} hoped, {printed[-1]:.1f} printed, uncommitted {late[-1]:.1f}"
        say(bands, name, said, sep=", ")
    return {
        "bands": bands,
        "honest": min(honest),
        "fitted": min(hoped),
        "printed": min(printed),
        "uncommitted": min(late),
    }


def grinding(mesh: Mesh, seen: dict[str, Mesh], tries: int) -> Row:
    """Redraw all chips by the last digits of a strength, and keep the best; what they multiply stays the same."""
    key = key_of(0)
    usual = jm.make_marker(mesh, key)
    profile = KeyedScheme().strengths(usual.original, usual.bits).tolist()
    scheme = KeyedScheme(profile=tuple(profile))
    marker = jm.make_marker(mesh, key, scheme=scheme)
    original = marker.original
    reader: Any = marker.reader
    aligned = {name: align(original, suspect) for name, suspect in seen.items()}
    ways = [reader.ways(marker.receive(one)) for one in aligned.values()]
    vectors = np.array([[np.asarray(reader.matched_residual(way)).ravel() for way in both] for both in ways])
    norms = np.linalg.norm(vectors.astype(np.float64), axis=2)
    fixed = {"content": "message", "scheme": scheme.name, "parameters": parameters_of(scheme), "bits": marker.bits}
    scores = np.empty((tries, *norms.shape))
    last = profile[-1]
    for attempt in range(tries):
        fixed["parameters"]["profile"] = (*profile[:-1], last + attempt * math.ulp(last))
        choices = bind(key, original.geometry, fixed)
        chips = make_chips(choices, original.chip_places, marker.code_bits)
        spread = chips.signs * encode(MESSAGE, choices, marker.code_bits)[chips.slots]
        scores[attempt] = vectors @ spread.ravel().astype(np.float32)
        if attempt % 10_000 == 0:
            say(f"{attempt} of {tries} tries")
    place = np.unravel_index(np.argmax(scores / norms), scores.shape)
    name = list(seen)[place[1]]
    record = remade(record_of(marker), key, mesh, (*profile[:-1], last + int(place[0]) * math.ulp(last)))
    best = jm.make_marker(mesh, key, record=record).read(aligned[name], MESSAGE)
    return {
        "tries": tries * len(seen),
        "by chance": -math.log10(tries * len(seen)),
        "best printed": best.log10_p,
        "uncommitted": best.evidence.log10_p_uncommitted,
        "suspect": name,
    }


class Edit(NamedTuple):
    """An edit of the original, made with knowledge of the mark."""

    chosen: str  # how the points are chosen
    share: float  # share of the points that are moved
    size: str  # how far they are moved
    vertices: np.ndarray


def edits(mesh: Mesh, shift: np.ndarray, suspect: Mesh, grid: float) -> Iterator[Edit]:
    """Move points against the mark, or just far enough that the imprint no longer recognises them."""
    vertices = np.asarray(mesh.vertices, np.float64)
    by_mark = np.argsort(-np.linalg.norm(shift, axis=1), kind="stable")
    for share, factor in product(SHARES, FACTORS):
        moved, some = vertices.copy(), by_mark[: int(share * len(vertices))]
        moved[some] -= factor * shift[some]
        yield Edit("moved most by the mark", share, f"{factor:g} of the mark", moved)
    along = np.sum((np.asarray(suspect.vertices) - vertices) * shift, axis=1)
    rng = np.random.default_rng(0)
    orders = {"against the mark in the noisy suspect": np.argsort(along), "random": rng.permutation(len(along))}
    for (name, order), share in product(orders.items(), SHARES[:-1]):
        moved, some = vertices.copy(), order[: int(share * len(vertices))]
        moved[some] += GRID_STEPS * grid * rng.choice([-1, 1], moved[some].shape)
        yield Edit(name, share, f"{GRID_STEPS} steps of the grid", moved)


def edited(mesh: Mesh) -> list[Row]:
    """Read unmarked suspects with originals that were edited, with and without the edited points."""
    key = key_of(0)
    marker = jm.make_marker(mesh, key)
    marked, info = marker.write(marker.codeword(MESSAGE), BUDGET, content=MESSAGE)
    shift = np.asarray(marked.vertices) - np.asarray(mesh.vertices)
    noisy = jm.attack(mesh, "noise", NOISE, seed=1)
    rows = []
    for edit in edits(mesh, shift, noisy, marker.original.grid):
        row: Row = {"points": edit.chosen, "share": edit.share, "moved by": edit.size}
        rows.append(row)
        try:
            reading = marker_with(jm.make_mesh(edit.vertices, mesh.faces), key, info.record)
        except jm.JaxmarkError as refusal:
            row["original"] = "refused: " + str(refusal).partition(": ")[2].partition(",")[0]
            continue
        row["original"] = "edited" if reading.caveats else "recovered exactly"
        kept = (reading.original.places >= 0)[reading.original.weld.point]  # the points that were not edited
        found = {
            "log10 p": reading.detect(mesh, MESSAGE),
            "with noise": reading.detect(noisy, MESSAGE),
            "with noise, edited points ignored": reading.detect(noisy, MESSAGE, kept.astype(float)),
        }
        row |= {name: one.log10_p for name, one in found.items()}
        row["detected"] = any(one.detected() for one in found.values())
        say(*row.values(), sep=", ")
    return rows


def marker_with(original: Mesh, key: jm.Key, record: Record) -> NonBlindMarker:
    return jm.make_marker(original, key, record=record)


def message(mesh: Mesh, seen: dict[str, Mesh], bits: int) -> Row:
    """The message that decodes best under one key, if 2^28 hashes find one like it whose tag fits."""
    try:
        marker = jm.make_marker(mesh, key_of(0), bits=bits)
    except jm.JaxmarkError as refusal:
        return {"payload": bits, "suspect": f"refused: {refusal}"}
    reader: Any = marker.reader
    chips, best = reader.carrier.chips, (0.0, "none")
    for name, suspect in seen.items():
        aligned = align(marker.original, suspect)
        for way in reader.ways(marker.receive(aligned)):
            vector = np.asarray(reader.matched_residual(way), np.float64)
            soft = np.bincount(np.ravel(chips.slots), np.ravel(chips.signs * vector), marker.code_bits)
            word = polar.decode(soft[None] / np.abs(soft).max(), bits + TAG_BITS, 64)[0][0]
            score = soft @ (1.0 - 2.0 * polar.encode(word, marker.code_bits))
            charges = ledger.ALIGNMENT.charge(aligned.align), ledger.PROOF.charge("score", 2)
            best = min(best, (figure(bounds.log10_p_score(score, np.linalg.norm(vector)), charges), name))
    charged = min(0.0, best[0] + bits * math.log10(2))
    return {
        "payload": bits,
        "suspect": best[1],
        "committed": best[0],
        "uncommitted": uncommitted(charged),
        "uncommitted, messages not charged": uncommitted(best[0]),
    }


def claimed_score(marker: NonBlindMarker, suspect: Mesh) -> float:
    """Score of the message over its norm, by the first way of weighting."""
    score, norm = claims_of_mark(marker, marker.receive(marker.register(suspect)), MESSAGE)[0]
    return float(score) / float(norm)


def scenes(mesh: Mesh, count: int) -> list[Row]:
    """Unite the originals that agree with an unmarked suspect."""
    key, suspect = key_of(0), jm.attack(mesh, "noise", 0.001, seed=1)
    originals = {str(number): jm.attack(mesh, "noise", VARIANT, seed=number + 2) for number in range(count)}
    markers = {name: jm.make_marker(one, key, bits=8 * len(MESSAGE)) for name, one in originals.items()}
    scores = {}
    for name, marker in markers.items():
        scores[name] = claimed_score(dataclasses.replace(marker), suspect)
        if len(scores) % 100 == 0:
            say(f"{len(scores)} of {count} originals")
    recorded = list(originals)[:RECORDED]
    record = SceneRecord({name: record_of(markers[name]) for name in recorded})
    chosen, picked = best_set(scores), best_set({name: scores[name] for name in recorded})
    options = {"key": key, "message": MESSAGE, "align": "same"}
    free = detect_scene({"suspect": suspect}, originals={name: originals[name] for name in chosen}, **options)
    honest = {"originals": {name: originals[name] for name in recorded}, "record": record, **options}
    every = detect_scene({"suspect": suspect}, **honest)
    by_name = detect_scene({"suspect": suspect}, **honest, names=picked)
    wreck = jm.attack(mesh, "noise", 0.05, seed=0)
    damaged = {name: original if name in picked else wreck for name, original in honest["originals"].items()}
    try:
        figure_of_damaged = f"{detect_scene({'suspect': suspect}, **{**honest, 'originals': damaged}).log10_p:.2f}"
    except jm.JaxmarkError:
        figure_of_damaged = "refused"
    return [
        {"originals": f"{len(chosen)} of {count} variants", **both(free)},
        {"originals": f"all {len(recorded)} of a record", **both(every)},
        {"originals": f"{len(picked)} of {len(recorded)} of a record, by name", **both(by_name)},
        {"originals": f"{len(picked)} of {len(recorded)} of a record, others damaged", "committed": figure_of_damaged},
    ]


def best_set(scores: dict[str, float]) -> list[str]:
    """The meshes whose scores have the largest sum over the root of their number."""
    names = sorted(scores, key=lambda name: -scores[name])
    sums = np.cumsum([scores[name] for name in names]) / np.sqrt(np.arange(1, len(names) + 1))
    return names[: int(np.argmax(sums)) + 1]


def both(found: Detection) -> Row:
    return {"committed": found.log10_p, "uncommitted": found.evidence.log10_p_uncommitted}


def records(mesh: Mesh) -> list[Row]:
    """Load records of a scene with forged fields, which the owner sealed, and read with those that load."""
    key, suspect = key_of(0), jm.attack(mesh, "noise", 0.001, seed=1)
    originals = {name: jm.attack(mesh, "noise", VARIANT, seed=seed) for seed, name in enumerate("ab", 2)}
    honest = {name: record_of(jm.make_marker(one, key)) for name, one in originals.items()}
    scene = json.loads(SceneRecord(honest).to_json())
    edits: dict[str, dict[str, Any]] = {
        "none": {},
        "bits -1000": {"bits": -1000},
        "bits 8": {"bits": 8},
        "bits 2^40": {"bits": 2**40},
        "no commitment to a message": {"told": ""},
        "presence": {"bits": 0, "content": "presence", "told": ""},
        "another scheme": {"scheme": "host", "parameters": {}},
        "another key": {"key": "0" * 64},
        "beta NaN": {"beta": math.nan},
    }
    rows = []
    for edit, fields in edits.items():
        for name in originals:
            meshes = {**scene["meshes"], name: {**scene["meshes"][name], **fields}}
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "record.json")
                path.write_text(json.dumps({**scene, "meshes": meshes}))
                try:
                    record = load_record(path)
                    assert isinstance(record, SceneRecord)
                    sealed = SceneRecord({name: one.sealed(key) for name, one in record.meshes.items()})
                    found = detect_scene({"x": suspect}, originals=originals, key=key, record=sealed, message=MESSAGE)
                    charges = make_commitment([sealed.digest()]).charges(sealed, claimed=True)
                    result = found.evidence.charged(*charges).log10_p
                except jm.JaxmarkError as refusal:
                    result = "refused: " + str(refusal).replace(str(path), "the file")
            rows.append({"edit": edit, "mesh": name, "timestamped": result})
    return rows


def try_scenes(mesh: Mesh, options: argparse.Namespace) -> Checks:
    rows = scenes(mesh, options.originals)
    print(f"originals chosen by their scores\n\n{table(rows)}\n")
    _, every, by_name, damaged = rows
    fixed = [row["committed"] for row in (every, by_name)]
    return {
        "uncommitted claims of scenes": all(row.get("uncommitted", 0.0) >= -SLACK for row in rows),
        "claims of recorded scenes": min(fixed) >= -SLACK and damaged["committed"] == "refused",
    }


def try_records(mesh: Mesh, options: argparse.Namespace) -> Checks:
    rows = records(mesh)
    print(f"forged records of a scene\n\n{table(rows)}\n")
    figures = [row["timestamped"] for row in rows if not isinstance(row["timestamped"], str)]
    return {"forged records of scenes": min(figures) >= -SLACK}


def try_strengths(mesh: Mesh, options: argparse.Namespace) -> Checks:
    seen = suspects(mesh)
    chance = -math.log10(options.keys * len(seen)) - SLACK
    rows = [strengths(mesh, seen, options.keys, bands) for bands in options.bands]
    print(f"strengths fitted, lowest of {options.keys} keys and {len(seen)} suspects\n\n{table(rows)}\n")
    return {
        "claims by fitted strengths": all(row.get("printed", 0.0) >= chance for row in rows),
        "uncommitted claims by fitted strengths": all(row.get("uncommitted", 0.0) >= chance for row in rows),
    }


def try_grinding(mesh: Mesh, options: argparse.Namespace) -> Checks:
    row = grinding(mesh, suspects(mesh), options.tries)
    print(f"chips drawn anew by the last digits of a strength\n\n{table([row])}\n")
    return {"grinding": row["best printed"] >= row["by chance"] - SLACK <= row["uncommitted"]}


def try_edited(mesh: Mesh, options: argparse.Namespace) -> Checks:
    rows = edited(mesh)
    print(f"an original edited with knowledge of the mark; unmarked suspects\n\n{table(rows)}\n")
    return {"detections by edited originals": not any(row.get("detected", False) for row in rows)}


def try_message(mesh: Mesh, options: argparse.Namespace) -> Checks:
    seen = suspects(mesh)
    rows = [message(mesh, seen, bits) for bits in PAYLOADS]
    print(f"the message that decodes best, without its tag\n\n{table(rows)}\n")
    return {"uncommitted claims of a chosen message": all(row.get("uncommitted", 0.0) >= -SLACK for row in rows)}


SECTIONS: dict[str, Callable[[Mesh, argparse.Namespace], Checks]] = {
    "strengths": try_strengths,
    "grinding": try_grinding,
    "edited": try_edited,
    "message": try_message,
    "scenes": try_scenes,
    "records": try_records,
}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh", metavar="MESH")
    parser.add_argument("--keys", type=int, default=20, help="keys under which strengths are fitted")
    parser.add_argument("--bands", type=int, nargs="+", default=[64, 128, 256, 512, 1024], help="numbers of strengths")
    parser.add_argument("--tries", type=int, default=100_000, help="records that are ground")
    parser.add_argument("--originals", type=int, default=1200, help="originals of which scenes are chosen")
    for name in SECTIONS:
        parser.add_argument(f"--{name}", action="store_true", help="run this section, and not those without a flag")
    options = parser.parse_args()
    mesh = load(parser, options.mesh)
    chosen = [name for name in SECTIONS if getattr(options, name)] or SECTIONS
    checks: Checks = {}
    for name in chosen:
        checks |= SECTIONS[name](mesh, options)
    for name, holds in checks.items():
        print(f"{name}: {'no more than chance' if holds else 'FORGED'}")
    sys.exit(0 if all(checks.values()) else 1)


if __name__ == "__main__":
    main()
