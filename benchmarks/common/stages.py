"""The stages that `speed.py` measures, each in a new process: python stages.py STAGE FOLDER REPEAT.

The folder contains the mesh, `mesh.ply`; the measurements are printed as JSON. A stage is a function that prepares the
call to measure, from the folder; the preparation is not measured. Not a program of its own: `apart` runs it.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import linalg

import jaxmark as jm
from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import make_original
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.laplacian import Laplacian, sparse_matrices
from jaxmark.watermark.interfaces import Scheme
from jaxmark.watermark.schemes.modulated import EigenScheme

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.filters import DEGREE, coefficients, graph, reordered, shifted
from common.marks import BUDGET, KEY, MESSAGE, write
from common.peers import PEERS
from common.tables import Row
from common.timing import Call, Compilation, median_time, timed

BLIND = ("field", "local")
SHORT = b"m2"  # a message, shorter than MESSAGE, that blind marks carry on small meshes, too
EIGENVECTORS = 64


def with_gradients(operator: Laplacian, c: Any, x: Any) -> Any:
    """The sum of the squares of f(Δ)x, and its gradients to coefficients and signal."""
    return jax.value_and_grad(lambda c, x: jnp.sum(filter(operator, c, x) ** 2), (0, 1))(c, x)


def filtering(folder: Path, function: Callable[..., Any]) -> Call:
    """A function of operator, coefficients and signal, compiled beforehand."""
    original = make_original(jm.load_mesh(folder / "mesh.ply"))
    inputs = (original.operator, coefficients(DEGREE), original.signal)
    return partial(jax.jit(function).lower(*inputs).compile(), *inputs)


def embedding(folder: Path, **options: Any) -> Call:
    return partial(jm.embed, jm.load_mesh(folder / "mesh.ply"), MESSAGE, KEY, **options)


def writing(folder: Path, scheme: str | Scheme) -> Call:
    """Embedding without reading back."""
    mesh = jm.load_mesh(folder / "mesh.ply")
    return lambda: write(jm.make_marker(mesh, KEY, bits=8 * len(MESSAGE), scheme=scheme), MESSAGE, BUDGET)


def detecting(folder: Path) -> Call:
    return partial(jm.detect, jm.load_mesh(folder / "marked.ply"), original=jm.load_mesh(folder / "mesh.ply"), key=KEY)


def marking_blindly(folder: Path, scheme: str) -> Call:
    """Marking for reading without the original, with the usual limits; the mark is kept for `reading_blindly`."""
    mesh, marked = jm.load_mesh(folder / "mesh.ply"), folder / f"{scheme}.ply"
    return lambda: jm.save_mesh(jm.embed(mesh, SHORT, KEY, scheme=scheme)[0], marked)


def reading_blindly(folder: Path, scheme: str) -> Call:
    return partial(jm.detect, jm.load_mesh(folder / f"{scheme}.ply"), key=KEY, bits=8 * len(SHORT), scheme=scheme)


def filtering_there(folder: Path, name: str) -> Call:
    """The filter by another program."""
    operator, x = graph(make_original(jm.load_mesh(folder / "mesh.ply")))
    return PEERS[name](shifted(operator), coefficients(DEGREE), np.asarray(x))


def decomposing(folder: Path) -> Call:
    """The lowest eigenvectors by SciPy, shift-and-invert, as whoever has no filters would take them."""
    operator, x = graph(make_original(jm.load_mesh(folder / "mesh.ply")))
    stiffness, mass = sparse_matrices(operator)
    start = np.random.default_rng(0).normal(size=len(x))
    return partial(linalg.eigsh, stiffness.tocsc(), EIGENVECTORS, mass.tocsc(), sigma=-1e-6, v0=start)


def aligning(folder: Path, by_surface: bool) -> Call:
    original, suspect = make_original(jm.load_mesh(folder / "mesh.ply")), jm.load_mesh(folder / "marked.ply")
    return (
        partial(align, original, suspect, "similarity") if by_surface else partial(align, original, reordered(suspect))
    )


def tuning(folder: Path) -> Call:
    attacks = [("noise", 0.005), ("smoothing", 10)]
    return partial(jm.tune, jm.load_mesh(folder / "mesh.ply"), attacks, BUDGET, seed=0)


WHOLE: Mapping[str, Callable[[Path], Call]] = {
    "load": lambda folder: partial(jm.load_mesh, folder / "mesh.ply"),
    "prepare": lambda folder: partial(make_original, jm.load_mesh(folder / "mesh.ply")),
    "embed": partial(embedding, budget=BUDGET),  # leaves the marked mesh for those below
    "embed, limits": embedding,
    "embed, eigenvectors": partial(embedding, budget=BUDGET, scheme=EigenScheme()),
    "write": partial(writing, scheme="keyed"),
    "write, eigenvectors": partial(writing, scheme=EigenScheme()),
    "detect": detecting,
    "align, reordered": partial(aligning, by_surface=False),
    "align, surfaces": partial(aligning, by_surface=True),
    "tune, two attacks": tuning,
}
STAGES = {
    **WHOLE,
    **{f"mark, {scheme}": partial(marking_blindly, scheme=scheme) for scheme in BLIND},
    **{f"read, {scheme}": partial(reading_blindly, scheme=scheme) for scheme in BLIND},
    **{f"filter, {name}": partial(filtering_there, name=name) for name in PEERS},
    "eigsh": decomposing,
    "filter": partial(filtering, function=filter),
    "gradients": partial(filtering, function=with_gradients),
}

FILTERS = ("filter", "gradients")  # of the stages, those that are one function of arrays


def work(stage: str, folder: Path, repeat: int) -> Row:
    """Measure a stage in this process, which is a fresh one."""
    try:
        call = STAGES[stage](folder)
        compilation = Compilation()
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # on Linux: the peak counts from here
        held, start = resident("VmRSS"), time.perf_counter()
        result: Any = jax.block_until_ready(call())
    except jm.JaxmarkError as refusal:
        return {"note": str(refusal)}
    row: Row = {"first call, s": time.perf_counter() - start}
    row |= {"compiling, s": compilation.seconds, "programs": compilation.programs}
    row |= {"held, GB": held / 1e9, "peak, GB": resident("VmHWM") / 1e9}
    if stats := jax.devices()[0].memory_stats():
        row["device peak, GB"] = stats["peak_bytes_in_use"] / 1e9
    if stage == "embed":
        jm.save_mesh(result[0], folder / "marked.ply")
    return row | ({"later calls, s": median_time(call, repeat, counted=True)} if repeat else {})


def resident(field: Literal["VmRSS", "VmHWM"]) -> int:
    """Bytes of memory held now or at most; `ru_maxrss`, if need be, also counts what started this process."""
    try:
        return 1024 * int(Path("/proc/self/status").read_text().split(field + ":")[1].split()[0])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def apart(mesh: jm.Mesh, stages: Sequence[str], repeat: int = 0) -> Iterator[Row]:
    """Measure stages one by one in processes of their own."""
    with tempfile.TemporaryDirectory() as folder:
        jm.save_mesh(mesh, Path(folder) / "mesh.ply")
        for stage in stages:
            command = [sys.executable, __file__, stage, folder, str(repeat)]
            run, seconds = timed(subprocess.run, command, capture_output=True, text=True)
            lost = {"note": f"ended with status {run.returncode}: {run.stderr.strip()[-200:]}"}
            found = json.loads(run.stdout.splitlines()[-1]) if run.returncode == 0 else lost
            yield {"vertices": len(mesh.vertices), "stage": stage} | found | {"process, s": seconds}


def main() -> None:
    stage, folder, repeat = sys.argv[1:]
    print(json.dumps(work(stage, Path(folder), int(repeat))))


if __name__ == "__main__":
    main()
