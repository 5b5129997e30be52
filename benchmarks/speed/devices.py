"""Time filters over devices of one machine: python benchmarks/speed/devices.py [--vertices 200000] [--degree 32].

The mesh is a torus of triangles, with three float32 columns. Strong scaling keeps the mesh and adds devices; weak
scaling keeps the number of vertices for each device. Devices are in one process, or in two processes that communicate
by `jax.distributed`. One process prepares the parts and writes them to files, which the others map, so that each reads
only its own. Devices here are threads of one processor: the table shows the amounts of data that are sent and held, and
that results agree, but not the speed of several machines.
"""

import math
import pickle
import resource
import socket
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmark.geometry.mesh import Mesh, make_mesh
from jaxmark.spectral import chebyshev, sharding
from jaxmark.spectral.graphs import from_mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser
from common.tables import Row, head, line, save_json
from common.timing import median_time, timed

HEADS = {
    "scaling": "scaling",
    "layout": "processes × devices",
    "vertices": "vertices",
    "product_ms": "ms per product",
    "per_root": "rows sent by a device / √its rows",
    "bytes": "bytes held per row",
    "per_cut_edge": "rows sent / cut edges",
    "sent": "rows sent",
    "rounds": "rounds",
    "prepare_mib": "MiB to prepare",
    "start_mib": "MiB at start",
    "peak_mib": "MiB at most",
    "error": "largest difference",
}


def torus(count: int) -> Mesh:
    """About so many vertices, twice as many along as around."""
    around = round((count / 2) ** 0.5)
    along = count // around
    i, j = np.divmod(np.arange(along * around), around)
    u, v = 2 * np.pi * i / along, 2 * np.pi * j / around
    points = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
    here, next_i = i * around, (i + 1) % along * around
    next_j = (j + 1) % around
    corners = [here + j, next_i + j, here + next_j], [here + next_j, next_i + j, next_i + next_j]
    return make_mesh(points, np.concatenate([np.stack(corner, axis=1) for corner in corners]))


def prepare(folder: Path, count: int, devices: int, degree: int, repeat: int) -> Row:
    """Leave parts, signal, coefficients and what one device makes of them in a folder."""
    mesh = torus(count)
    operator = from_mesh(mesh)
    parts, seconds = timed(sharding.partition, operator, devices, mesh.vertices)
    most = peak_mib()
    leaves, structure = jax.tree.flatten(parts)
    x = np.asarray(mesh.vertices, np.float32)
    c = np.random.default_rng(0).normal(size=degree + 1).astype(np.float32)
    traced = jax.tree.map(jax.numpy.asarray, operator)
    plain = jax.jit(chebyshev.filter)
    arrays = [x, c, np.asarray(plain(traced, c, x)), *leaves]
    for k, array in enumerate(arrays):
        np.save(folder / f"{k}.npy", array)
    # Indices in place of leaves: structures themselves do not pickle.
    (folder / "parts.pickle").write_bytes(pickle.dumps(jax.tree.unflatten(structure, range(3, len(arrays)))))
    found = sharding.traffic(parts)
    return {
        "vertices": len(x),
        "prepare_s": seconds,
        "prepare_mib": most,
        "plain_product_ms": 1e3 * median_time(lambda: plain(traced, c, x), repeat, patience=math.inf) / degree,
        "rounds": len(parts.plan.rounds),
        "per_cut_edge": found.per_cut_edge,
        **found._asdict(),
    }


def measure(folder: Path, index: int, processes: int, port: int, devices: int, repeat: int) -> Row:
    """One process of several: filter with its own parts, and compare them with what one device makes."""
    jax.config.update("jax_num_cpu_devices", devices // processes)
    if processes > 1:
        jax.distributed.initialize(f"localhost:{port}", num_processes=processes, process_id=index)
    jax.devices()
    started = peak_mib()

    def load(k: int) -> np.ndarray:
        return np.load(folder / f"{k}.npy", mmap_mode="r")

    x, c, expected = map(load, range(3))
    sharded = sharding.place(jax.tree.map(load, pickle.loads((folder / "parts.pickle").read_bytes())), jax.devices())
    there = sharded.scatter(x)
    # All processes must call equally often, so that none may lose patience.
    seconds = median_time(lambda: sharding.filter_sharded(sharded, c, there), repeat, patience=math.inf)
    most = peak_mib()
    # What was expected, laid out as the result is: each process compares what it holds.
    pairs = zip(
        *(y.addressable_shards for y in (sharding.filter_sharded(sharded, c, there), sharded.scatter(expected))),
        strict=True,
    )
    error = max(float(np.abs(np.asarray(one.data) - np.asarray(other.data)).max()) for one, other in pairs)
    row = {"product_ms": 1e3 * seconds / (len(c) - 1), "start_mib": started, "peak_mib": most, "error": error}
    if processes > 1:
        jax.distributed.shutdown()
    return row | {"largest": float(np.abs(expected).max())}


def peak_mib() -> float:
    """The most memory that this process has held, in MiB; Linux counts in KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def case(count: int, processes: int, devices: int, degree: int, repeat: int) -> Row:
    """One row; all work is in processes of their own, since a child's peak starts at its parent's."""
    spawn = get_context("spawn")
    with tempfile.TemporaryDirectory() as name, socket.socket() as free:
        folder = Path(name)
        with ProcessPoolExecutor(1, spawn) as pool:
            row = pool.submit(prepare, folder, count, devices, degree, repeat).result()
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
        free.close()
        with ProcessPoolExecutor(processes, spawn) as pool:
            runs = [pool.submit(measure, folder, k, processes, port, devices, repeat) for k in range(processes)]
            rows = [run.result() for run in runs]
    return row | {
        "layout": f"{processes} × {devices // processes}",
        "product_ms": max(one["product_ms"] for one in rows),
        "start_mib": [one["start_mib"] for one in rows],
        "peak_mib": [one["peak_mib"] for one in rows],
        "error": max(one["error"] for one in rows) / rows[0]["largest"],
    }


def traffic(count: int, devices: int) -> Row:
    """What partitions alone say, also of more devices than there are here."""
    mesh = torus(count)
    parts = sharding.partition(from_mesh(mesh), devices, mesh.vertices)
    found = sharding.traffic(parts)
    rows = parts.vertices.shape[1]
    held = sum(leaf.size * min(leaf.itemsize, 4) for leaf in jax.tree.leaves(parts))
    return {
        "scaling": "traffic",
        "layout": f"1 × {devices}",
        "vertices": len(mesh.vertices),
        "rows": rows,
        "per_root": found.sent / devices / rows**0.5,
        "bytes": held / devices / rows,
        "rounds": len(parts.plan.rounds),
        "per_cut_edge": found.per_cut_edge,
        **found._asdict(),
    }


def shown(value: Any) -> str:
    """A table's cell."""
    match value:
        case float():
            return f"{value:.1e}" if 0 < value < 1e-3 else f"{value:.2f}" if value < 100 else f"{value:.0f}"
        case list():
            return ", ".join(f"{one:.0f}" for one in value)
    return str(value)


def show(row: Row, first: bool) -> None:
    """Print a line of a table, and the table's head before the first."""
    columns = [key for key in HEADS if key in row]
    if first:
        print(head(*(HEADS[key] for key in columns)))
    print(line(*(shown(row[key]) for key in columns)), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--vertices", type=int, default=200_000, help="of the mesh; for weak scaling, over four devices"
    )
    parser.add_argument("--layouts", nargs="+", default=["1x1", "1x2", "1x4", "2x1", "2x2"], help="processes x devices")
    parser.add_argument("--scaling", nargs="+", default=["strong", "weak"], choices=["strong", "weak"])
    parser.add_argument("--degree", type=int, default=32)
    parser.add_argument("--parts", type=int, nargs="+", help="only partition, into so many, and say what is sent")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--output", type=Path, help="for all figures, as JSON")
    options = parser.parse_args()
    if options.parts:
        for place, row in enumerate([traffic(options.vertices, parts) for parts in options.parts]):
            show(row, place == 0)
        return
    cases = []
    for scaling, layout in product(options.scaling, options.layouts):
        processes, each = map(int, layout.split("x"))
        share = 1 if scaling == "strong" else processes * each / 4
        cases.append((scaling, int(options.vertices * share), processes, processes * each))
    rows = []
    for scaling, count, processes, devices in cases:
        rows.append({"scaling": scaling} | case(count, processes, devices, options.degree, options.repeat))
        show(rows[-1], len(rows) == 1)
        if options.output:
            save_json(options.output, rows)
    for scaling in options.scaling:
        plain = [row["plain_product_ms"] for row in rows if row["scaling"] == scaling]
        print(f"{scaling}: one device without sharding, ms per product: {', '.join(f'{ms:.2f}' for ms in plain)}")


if __name__ == "__main__":
    main()
