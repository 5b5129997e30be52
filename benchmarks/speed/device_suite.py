"""Measure filters, marks and commands on one device: python benchmarks/speed/device_suite.py [--output FOLDER].

It runs on whatever device JAX finds, in about 8 minutes on a large GPU, and writes FOLDER/device_suite.md and .json.
The meshes are bumpy tori. Times are medians of --repeat calls after a first one that is not counted. The parts:

filters   f(Δ)x of degree 64, float32, operator and signal on the device, in milliseconds, 20 calls in a row: of one,
          three and four columns; by segment-sums; the value and both gradients of three columns; PyTorch's sparse CSR
          products (extra `peers`); and a CUDA kernel of one launch a degree, which CuPy compiles and launches as one
          graph; with their largest difference from our result over the largest value.
readings  claims of one mark: --keys keys and one suspect, then one key and as many suspects, each by one compiled call
          over chunks of 50, and by a loop over keys, of which ten are timed; with the largest difference of the
          evidence in nats, and the host's time to derive the keys' arrays.
use       first and later calls of embedding at an RMS displacement of 0.08 %, detecting, 32 readings of bits, eight at
          a time, and 30 steps of descent on the evidence.
commands  `jaxmark embed` and `jaxmark detect`, each in a process, first and second runs, on the device and on the
          processors beside it.
"""

import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmark as jm
from jaxmark import spectral
from jaxmark.errors import JaxmarkError
from jaxmark.watermark.bits import detect_bits
from jaxmark.watermark.coding.keys import save_key
from jaxmark.watermark.markers import NonBlindMarker

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser, positive
from common.filters import DEGREE, bumpy_torus, coefficients, shifted
from common.marks import BUDGET, KEY, MESSAGE
from common.peers import Run, by_cuda, by_torch
from common.tables import Row, save, say, table
from common.timing import for_commands, median_time, time_in_row, timed

SIZES = (35_000, 300_000, 1_000_000, 4_000_000, 16_000_000)
LARGEST_FOR_TORCH = 4_000_000  # it takes longer than all others together
CHUNK, LOOPED, STEPS = 50, 10, 30


def filters(size: int, repeat: int) -> Row:
    """Milliseconds of all variants of a filter on a mesh of a size."""
    mesh = bumpy_torus(size)
    on_host = spectral.from_mesh(mesh)
    operator, c = jax.device_put(on_host), jnp.asarray(coefficients(DEGREE))
    signals = {count: jax.random.normal(jax.random.key(count), (len(mesh.vertices), count)) for count in (1, 3, 4)}
    run = jax.jit(spectral.filter)
    both = jax.jit(jax.value_and_grad(lambda o, c, x: jnp.sum(jnp.sin(spectral.filter(o, c, x))), (1, 2)))
    x = signals[3]
    row: Row = {"vertices": len(mesh.vertices)}
    row |= {f"{n} columns": 1e3 * time_in_row(lambda x=s: run(operator, c, x), repeat) for n, s in signals.items()}
    row["segment-sums"] = 1e3 * time_in_row(lambda: run(operator.by_segments, c, x), repeat)
    row["value, gradients"] = 1e3 * time_in_row(lambda: both(operator, c, x), repeat)
    ours, numbers, values = np.asarray(run(operator, c, x)), np.asarray(c), np.asarray(x)
    others: dict[str, Callable[[], Run]] = {}
    if size <= LARGEST_FOR_TORCH:
        others["torch"] = lambda: by_torch(shifted(on_host), numbers, values)
    if jax.default_backend() == "gpu":
        others["CUDA kernel"] = lambda: by_cuda(on_host, numbers, values)
    for name, make in others.items():
        try:
            other = make()
        except JaxmarkError as missing:
            row[name] = str(missing).split(" is needed")[0] + " is missing"
            continue
        expected = np.asarray(other())
        row[name] = 1e3 * time_in_row(other, repeat)
        difference = float(np.abs(ours - expected).max() / np.abs(expected).max())
        row["difference"] = max(difference, float(row.get("difference") or 0))
    return row


def readings(marker: NonBlindMarker, keys: int, repeat: int) -> Iterator[Row]:
    """Seconds of many claimed readings at once, and one by one."""
    others = [jm.Key(seed.to_bytes(32, "big")) for seed in range(keys)]
    arrays = marker.arrays(MESSAGE)
    batch, prepared = timed(marker.arrays_of_keys, MESSAGE, others)
    suspect = arrays.embed(BUDGET) + 1e-3 * jax.random.normal(jax.random.key(0), arrays.x.shape)

    @jax.jit
    def by_keys(batch, suspect):
        received = batch.first().receive(suspect)
        return batch.map(lambda one: one.claim(received), chunk=CHUNK)

    looped = [NonBlindMarker.make(marker.original, key, marker.scheme, marker.bits) for key in others[:LOOPED]]
    one = jax.jit(lambda arrays, suspect: arrays.evidence(suspect))
    each = [mark.arrays(MESSAGE) for mark in looped]
    found = by_keys(batch, suspect)
    alone = jnp.stack([one(arrays, suspect) for arrays in each])
    yield {
        "readings": f"{keys} keys, 1 suspect",
        "seconds": median_time(lambda: by_keys(batch, suspect), repeat),
        "by a loop": keys / LOOPED * median_time(lambda: [one(arrays, suspect) for arrays in each], repeat),
        "difference": float(jnp.abs(found[:LOOPED] - alone).max()),
        "keys on the host": prepared,
    }
    seeds = jnp.arange(keys)

    @jax.jit
    def by_suspects(arrays, seeds):
        def noisy(seed):
            return arrays.evidence(
                arrays.embed(BUDGET) + 1e-3 * jax.random.normal(jax.random.key(seed), arrays.x.shape)
            )

        return jax.lax.map(noisy, seeds, batch_size=CHUNK)

    yield {"readings": f"1 key, {keys} suspects", "seconds": median_time(lambda: by_suspects(arrays, seeds), repeat)}


def use(mesh: jm.Mesh, repeat: int) -> Iterator[Row]:
    """Seconds of first and later calls of what users do."""
    marker, prepared = timed(jm.make_marker, mesh, KEY)
    yield {"step": "make_marker", "first": prepared}
    (marked, _), embedded = timed(marker.embed, MESSAGE, BUDGET)
    yield {"step": "embed", "first": embedded, "later": median_time(lambda: marker.embed(MESSAGE, BUDGET), repeat)}
    _, detected = timed(marker.detect, marked)
    yield {"step": "detect", "first": detected, "later": median_time(lambda: marker.detect(marked), repeat)}
    arrays = marker.arrays(MESSAGE)
    copies = arrays.embed(BUDGET) + 1e-4 * jax.random.normal(jax.random.key(0), (32, *arrays.x.shape))

    @jax.jit
    def read(arrays, copies):
        def decisions(suspect):
            return detect_bits(suspect, arrays.x, arrays.carrier, weights=arrays.moving)

        return jax.lax.map(decisions, copies, batch_size=8)

    yield {"step": "32 readings of bits", "later": median_time(lambda: read(arrays, copies), repeat)}
    slope = jax.jit(lambda a, x: jax.grad(lambda x: a.evidence(x))(x))

    def descend():
        suspect = arrays.embed(BUDGET)
        for _ in range(STEPS):
            suspect = suspect - 1e-5 * jnp.sign(slope(arrays, suspect))
        return suspect

    yield {"step": f"{STEPS} steps of descent", "later": median_time(descend, repeat)}


def commands(mesh: jm.Mesh) -> Iterator[Row]:
    """Seconds of whole commands, which keep their compiled programs in a folder of their own."""
    beside = [] if jax.default_backend() == "cpu" else ["cpu"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jm.save_mesh(mesh, folder / "mesh.ply")
        save_key(KEY, folder / "key")

        def run(platform: str, *words: str) -> None:
            command = [sys.executable, "-m", "jaxmark", *words, "--key", "key"]
            environment = for_commands(folder / f"cache-{platform}") | {"JAX_PLATFORMS": platform}
            subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)

        for platform in ["", *beside]:
            for words in (
                ("embed", "mesh.ply", "marked.ply", "--message", MESSAGE.hex(), "--overwrite"),
                ("detect", "marked.ply", "--original", "mesh.ply"),
            ):
                row: Row = {"command": words[0], "on": platform or jax.default_backend()}
                first, later = (timed(run, platform, *words)[1] for _ in range(2))
                yield row | {"vertices": len(mesh.vertices), "first": first, "second": later}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", type=positive, default=SIZES, help="vertices of the filters' meshes")
    parser.add_argument("--mark", type=positive, default=35_000, help="vertices of the marked mesh")
    parser.add_argument("--command", type=positive, default=312_300, help="vertices of the commands' mesh")
    parser.add_argument("--keys", type=positive, default=1000)
    parser.add_argument("--repeat", type=positive, default=5)
    parser.add_argument("--output", type=Path, default=Path("device_suite"), help="folder of the tables")
    given = parser.parse_args()
    device = jax.devices()[0]
    title = f"{device.device_kind} ({device.platform}), jax {jax.__version__}, Python {platform.python_version()}"
    parts: dict[str, list[Row]] = {}

    def keep(name: str, row: Row) -> None:
        """Write all tables after each row, so that a run that is cut short leaves what it has."""
        parts.setdefault(name, []).append(row)
        say(name, row)
        text = "\n\n".join([f"# {title}", *(f"## {name}\n\n{table(rows)}" for name, rows in parts.items())])
        save(given.output, "device_suite", text + "\n", {"device": title, **parts})

    mesh = bumpy_torus(given.mark)
    for row in use(mesh, given.repeat):
        keep("use", row)
    for row in readings(jm.make_marker(mesh, KEY), given.keys, given.repeat):
        keep("readings", row)
    for size in given.sizes:
        keep("filters", filters(size, given.repeat))
    for row in commands(bumpy_torus(given.command)):
        keep("commands", row)
    print((given.output / "device_suite.md").read_text())


if __name__ == "__main__":
    main()
