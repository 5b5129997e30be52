"""Measure the gain from tuning the bands: python benchmarks/robustness/tuning.py [MESH...] [--train MESH...].

For each mesh and limit, marks of equal distortion are compared: flat over the whole spectrum, low-pass by hand, the
library's default, the same in the usual pass band whatever the limit, the mean profile of the training meshes (never
those reported on), tuned on the mesh itself, and --around profiles whose strengths differ from the tuned ones by
chance. They are attacked with seeds, and written with keys, that had no part in tuning. The margin is the evidence for
a claimed message in nats, S²/2‖a‖², and the bound is the margin that no profile of these bands exceeds on the measured
channels. --strengths adds the largest strength of each kind of attack after which a message of --bits bits can still be
read. --untuned omits tuning, which takes minutes. Without meshes to report on, only the mean profile is printed, from
which the library's default is derived (`schemes.DERIVED`).
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark.alignment.original import make_original
from jaxmark.evaluation.tuning import Tuned, tune
from jaxmark.files.programs import release_programs
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.keyed import KeyedScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.marks import KEY, Subject, write
from common.strengths import largest
from common.tables import Row, head, line, save_json, say
from common.timing import timed

ATTACKS = ["noise=0.005", "noise=0.001", "smoothing=10", "smoothing=50", "quantisation=8", "quantisation=9"]
CHANNEL_TRIALS = "channel trials"
LOW_PASS = (8, 16, 32)
LIMITS = ["rms=0.0008", "gl=0.0002", "dame=0.008", "msdm2=0.12"]
UNSEEN = 1000  # first seed of the attacks reported
SPREAD = 0.3  # standard deviation of the logarithms of strengths around tuned ones


def strength(word: str) -> tuple[str, float]:
    """An attack and its strength, KIND=STRENGTH."""
    kind, value = word.split("=")
    return kind, float(value)


def tuned_on(mesh: Mesh, limits: Mapping[str, float], options: argparse.Namespace) -> Tuned:
    return tune(mesh, options.attacks, limits, seed=0, margin="evidence", bits=options.bits)


def profiles(
    mesh: Mesh, limits: Mapping[str, float], mean: KeyedScheme | None, own: Tuned | None, around: int, bits: int
) -> dict[str, Scheme]:
    found: dict[str, Scheme] = {"flat": KeyedScheme(profile=(1.0,) * KeyedScheme.bands)}
    found |= {f"low-pass {bands}": KeyedScheme(profile=(1.0,) * bands) for bands in LOW_PASS}
    if mean is not None:
        found["mean of the training meshes"] = mean
    suited = jm.make_marker(mesh, KEY, bits=bits).adapted(limits).scheme
    found |= {"usual pass band": KeyedScheme(), "default": suited}
    if own is None:
        return found
    strengths, random = own.beta[: 1 + np.flatnonzero(own.beta)[-1]], np.random.default_rng(0)
    for number in range(around):
        changed = strengths * np.exp(SPREAD * random.normal(size=len(strengths)))
        found[f"around {number}"] = KeyedScheme(profile=tuple(map(float, changed / changed.max())))
    return {**found, "tuned": own.scheme}


def average(found: list[Tuned]) -> KeyedScheme:
    """Mean power in each band of profiles of equal whole power."""
    power = np.mean([np.square(one.beta) / np.sum(one.beta**2) for one in found], axis=0)
    relative = np.sqrt(power / power.max())
    kept = np.where(relative >= 0.01, relative, 0)[: 1 + np.flatnonzero(relative >= 0.01)[-1]]
    return KeyedScheme(profile=tuple(float(f"{value:.2f}") for value in kept))


def evidence(
    mesh: Mesh, scheme: Scheme, limits: Mapping[str, float], options: argparse.Namespace
) -> tuple[list[float], float]:
    """Nats for a claimed message after each attack, the mean over keys and seeds; and the share of messages read."""
    found, read = np.zeros((options.keys, options.seeds, len(options.attacks))), []
    for number in range(options.keys):
        key = KEY if number == 0 else jm.Key(bytes([number] * 32))
        marker = jm.make_marker(mesh, key, bits=options.bits, scheme=scheme)
        message = bytes(options.bits // 8)
        word = marker.codeword(message)
        marked, _ = marker.write(word, limits)
        claimed = jnp.asarray(word, marker.original.signal.dtype)
        for seed in range(options.seeds):
            for place, (kind, strength) in enumerate(options.attacks):
                suspect = jm.attack(marked, kind, strength, seed=UNSEEN + seed)
                received = marker.receive(marker.register(suspect))
                score, norm = marker.reader.claim(received, claimed)
                found[number, seed, place] = max(float(score), 0) ** 2 / (2 * float(norm) ** 2)
                decoded = marker.decode(marker.soft_decisions(received))
                read.append(decoded is not None and decoded.message == message)
    return found.mean(axis=(0, 1)).tolist(), float(np.mean(read))


def strengths(mesh: Mesh, scheme: Scheme, limits: Mapping[str, float], bits: int, seeds: int) -> list[str]:
    """The largest from which the message reads, as in `robustness.py`."""
    subjects = []
    for seed in range(seeds):
        marker = jm.make_marker(mesh, jm.Key(bytes([seed + 1] * 32)), bits=bits, scheme=scheme)
        message = bytes(np.random.default_rng(seed).bytes(bits // 8))
        subjects.append(Subject(marker, write(marker, message, limits), message, 0.0))
    return [largest(subjects, kind)["cell"] for kind in ("noise", "laplace", "taubin", "quantisation")]


def reported(
    source: Path, mesh: Mesh, limits: Mapping[str, float], mean: KeyedScheme | None, options: argparse.Namespace
) -> list[Row]:
    own, seconds = (None, 0.0) if options.untuned else timed(tuned_on, mesh, limits, options)
    rows: list[Row] = []
    for name, scheme in profiles(mesh, limits, mean, own, options.around, options.bits).items():
        row: Row = {"mesh": source.name, "limit": limits, "profile": name}
        try:
            row["nats"], row["read"] = evidence(mesh, scheme, limits, options)
            if options.strengths:
                row["strengths"] = strengths(mesh, scheme, limits, options.bits, options.seeds)
        except jm.JaxmarkError as error:
            row["refused"] = str(error)
        rows.append(row)
        say(*row.values())
    if own is None:
        return rows
    rows[-1] |= {
        "trials": own.report.trials.tolist(),
        CHANNEL_TRIALS: own.report.channel_trials.tolist(),
        "default trials": own.report.default_trials.tolist(),
        "default_kept": own.report.default_kept,
        "bound": own.report.bound,
        "model": float(own.report.margins.min()),
        "gap": own.report.gap,
        "seconds": seconds,
        "beta": own.scheme.profile,
    }
    return rows


def table(rows: list[Row], attacks: list[tuple[str, float]]) -> str:
    """One mesh and limit."""
    last = rows[-1]
    limit = ", ".join(f"{name} {value:g}" for name, value in last["limit"].items())
    by_hand = [row for row in rows if row["profile"].startswith(("low-pass", "flat")) and "nats" in row]
    default = next(min(row["nats"]) for row in rows if row["profile"] == "default" and "nats" in row)
    best = max(min(row["nats"]) for row in by_hand) if by_hand else float("nan")
    heads = [f"{kind} {strength:g}" for kind, strength in attacks]
    heads += ["worst", "over the best by hand", "over the default", "read"]
    if any("strengths" in row for row in rows):
        heads += ["largest noise", "steps of 0.5", "Taubin pairs", "bits of quantisation"]
    text = [f"## {last['mesh']}, {limit}", "", head("profile", *heads)]
    for row in rows:
        if "refused" in row:
            cells = [row["refused"]] + [""] * (len(heads) - 1)
        else:
            worst = min(row["nats"])
            cells = [*(f"{nats:.1f}" for nats in row["nats"]), f"{worst:.1f}", f"{worst / best:.2f}"]
            cells += [f"{worst / default:.2f}", f"{row['read']:.0%}"]
            cells += row.get("strengths", [])
        text.append(line(row["profile"], *cells))
    if "trials" not in last:
        return "\n".join([*text, ""])
    note = (
        f"Tuned in {last['seconds']:.1f} s: by trials {min(last['trials']):.1f} nats, the default"
        f" {min(last['default trials']):.1f}, the best by channels"
        f" {min(last[CHANNEL_TRIALS]):.1f}; on the channels themselves {last['model']:.0f}, no profile above"
        f" {last['bound']:.0f} (gap {last['gap']:.2%})."
    )
    return "\n".join([*text, "", note, ""])


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser, nargs="*")
    parser.add_argument("--train", nargs="+", type=Path, default=[], help="meshes whose mean profile is tried")
    parser.add_argument("--attacks", nargs="+", type=strength, default=list(map(strength, ATTACKS)))
    parser.add_argument("--around", type=int, default=0, help="profiles around the tuned one")
    parser.add_argument("--untuned", action="store_true", help="leave out tuning")
    parser.add_argument("--keys", type=int, default=1)
    parser.add_argument("--limit", nargs="+", default=LIMITS, metavar="NAME=VALUE")
    parser.add_argument("--bits", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--strengths", action="store_true")
    parser.add_argument("--output", type=Path, help="JSON file, rewritten after each table")
    options = parser.parse_args()
    train = [jm.load_mesh(path) for path in options.train]
    known = {make_original(mesh).geometry for mesh in train}
    everything: list[Row] = []
    for limit in options.limit:
        name, value = limit.split("=")
        limits = {name: float(value)}
        mean = average([tuned_on(mesh, limits, options) for mesh in train]) if train else None
        if mean is not None:
            print(f"Mean profile of the training meshes, {limit}: {mean.profile}\n", flush=True)
        for source in options.meshes:
            release_programs()  # of the mesh before, which has another size
            mesh = jm.load_mesh(source)
            assert make_original(mesh).geometry not in known, f"{source} is a training mesh"
            rows = reported(source, mesh, limits, mean, options)
            print(table(rows, options.attacks), flush=True)
            everything += rows
            if options.output:
                save_json(options.output, everything)


if __name__ == "__main__":
    main()
