"""Compare float32 with float64, stage by stage: python benchmarks/theory/precision.py [MESH].

The whole chain runs twice on the same meshes, key and message; an error includes those of all earlier stages. The
suspect is a weakly marked mesh in noise, so that its claim is above the floor of the evidence.
"""

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark.app.demo import sample_mesh
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import band_components, filter, gram, moments
from jaxmark.watermark.evidence.bounds import log10_p_score
from jaxmark.watermark.reading.detectors import joint

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import load, make_parser
from common.marks import KEY, MESSAGE
from common.tables import head, line

BUDGET, NOISE = 5e-5, 5e-3
BANDS = 64
PRINTED = (0, 19, 63)  # bands: the strongest, the last that is written in, and one that holds little but rounding

Stages = Mapping[str, np.ndarray]


def chain(mesh: jm.Mesh, suspect: jm.Mesh | None) -> tuple[Stages, jm.Mesh]:
    """All stages in the precision that JAX is in, as float64, and the suspect, which the first run makes."""
    marker = jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE))
    reader: Any = marker.reader  # of a keyed carrier
    operator, signal = marker.original.operator, marker.original.signal
    marked, _ = marker.embed(MESSAGE, jm.Budget(rms=BUDGET, noise=0), read_back="never")
    suspect = jm.attack(marked, "noise", NOISE, seed=0) if suspect is None else suspect
    family = scaling(BANDS, damping="jackson")
    components = band_components(operator, family, signal)
    basis = np.asarray(reader.nuisance, np.float64)
    probe = np.random.default_rng(0).choice([-1.0, 1.0], len(basis))
    received = reader.receive(marker.observe(marker.register(suspect)))
    codeword = marker.codeword(MESSAGE)
    score, norm = reader.claim(received, jnp.asarray(codeword, signal.dtype))
    found = {
        "filter of degree 64": filter(operator, scaling(65, damping="jackson")[:20].sum(axis=0), signal),
        **{f"component of band {band + 1} of {BANDS}": components[band] for band in PRINTED},
        "moments": moments(operator, signal, degree=64),
        "Gram matrix by moments": gram(operator, family, signal, method="moments"),
        "Gram matrix by bands": gram(operator, family, signal),
        "random signs on the nuisance's span": basis @ np.linalg.lstsq(basis.T @ basis, basis.T @ probe)[0],
        "written displacement": marked.vertices - mesh.vertices,
        "residual after reception": received.residual,
        "weights of the bands": unit(received.gain / received.power),
        "soft values": unit(joint(reader, received)),
        "terms of the score": reader.carrier.spread(jnp.asarray(codeword, signal.dtype))
        * reader.matched_residual(received),
        "score": score,
        "norm": norm,
        "log10 p": log10_p_score(score, norm),
    }
    return {stage: np.asarray(value, np.float64) for stage, value in found.items()}, suspect


def unit(values: jax.Array) -> np.ndarray:
    """What is left once the scale is taken off, which proves nothing."""
    return np.asarray(values, np.float64) / np.linalg.norm(np.asarray(values, np.float64))


def errors(single: Stages, double: Stages) -> list[tuple[str, float, str]]:
    """Rows of the table: stage, error, and what it is relative to."""
    rows = []
    for stage, exact in double.items():
        if stage == "terms of the score":
            break
        rows.append((stage, float(np.linalg.norm(single[stage] - exact) / np.linalg.norm(exact)), "its norm"))
        if stage == "Gram matrix by bands":
            lengths = np.sqrt(np.einsum("cjj->cj", exact))
            worst = np.max(np.abs(single[stage] - exact) / lengths[:, :, None] / lengths[:, None])
            rows.append(("its worst entry", float(worst), "‖x_i‖ ‖x_j‖"))
    terms, norm, ratio = single["terms of the score"], float(single["norm"]), double["score"] / double["norm"]
    exact = double["terms of the score"] / double["norm"]
    return [
        *rows,
        ("terms a of the score, over ‖a‖", float(np.linalg.norm(terms / norm - exact)), "1"),
        ("S, of the same terms", abs(float(single["score"]) - math.fsum(terms.ravel())) / norm, "‖a‖"),
        ("‖a‖, of the same terms", abs(norm / float(np.linalg.norm(terms)) - 1), "‖a‖"),
        ("S/‖a‖", abs(float(single["score"] / norm / ratio) - 1), "itself"),
    ]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("mesh", nargs="?", help="by default the demo's")
    path = parser.parse_args().mesh or sample_mesh()
    mesh = load(parser, path)
    with jax.enable_x64(True):
        double, suspect = chain(mesh, None)
    single, _ = chain(mesh, suspect)
    points, bits = len(double["residual after reception"]), len(double["soft values"])
    print(f"{path}: {points} points, {bits} code bits, {jax.devices()[0].platform}")
    print(head("stage", "error in float32", "relative to"))
    for stage, error, scale in errors(single, double):
        print(line(stage, f"{error:.1e}", scale))
    print(f"log10 p: {double['log10 p']:.3f} in float64, {single['log10 p']:.3f} in float32")


if __name__ == "__main__":
    main()
