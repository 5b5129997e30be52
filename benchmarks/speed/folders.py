"""Time marking and reading a folder of meshes of different sizes: python benchmarks/speed/folders.py MESH...

The folder has the meshes, simplified to sizes between 1,500 vertices and their own. `jaxmark embed` and `jaxmark
detect` process it in one process, in several by --workers, and some of its files in one process each, as many at a time
as there are processors. Each starts with an empty cache of compiled programs, and is run twice.

s a file   seconds of the whole, over the number of files
over       files per second, relative to a process for each file in the same run
programs   number compiled, or loaded from the cache, as JAX logs it
kinds      number of these that differ in name and shapes, not only in constants such as a number of bands
memory     of all processes when each quarter of the files is done
"""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import jaxmark as jm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.tables import Row, say, table
from common.timing import for_commands

LEAST = 1500  # vertices
MESSAGE = "0123456789abcdef"
JAXMARK = [sys.executable, "-m", "jaxmark"]


def make_folder(folder: Path, meshes: list[Path], count: int) -> None:
    """Fill a folder with simplified meshes."""
    rng, loaded = np.random.default_rng(0), [jm.load_mesh(path) for path in meshes]
    for number in range(count):
        mesh = loaded[number % len(loaded)]
        share = np.exp(rng.uniform(np.log(min(1.0, LEAST / len(mesh.vertices))), 0))
        if share < 1:
            mesh = jm.attack(mesh, "simplification", 1 - share, seed=0)
        jm.save_mesh(mesh, folder / f"{number:04d}_{meshes[number % len(meshes)].stem}.ply")


def held(process: int) -> int:
    """Bytes of memory that a process and its children hold."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        return 1024 * int(status.split("VmRSS:")[1].split()[0]) + sum(held(int(child)) for child in children)
    except (OSError, IndexError):  # it has ended, or this is no Linux
        return 0


def run(words: list[str], cache: Path, count: int) -> Row:
    """Run one command on a folder, and watch what it says."""
    environment = {**for_commands(cache), "JAX_LOG_COMPILES": "1"}
    start, memory, said = time.perf_counter(), [], []
    with subprocess.Popen(
        [*JAXMARK, *words], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        listener = threading.Thread(target=lambda pipe=process.stderr: said.extend(pipe))
        listener.start()
        refused = 0
        for number, line in enumerate(process.stdout, 1):
            refused += ": refused." in line
            if number * 4 // count > len(memory):
                memory.append(f"{held(process.pid) / 1e9:.2f}")
        listener.join()
    seconds = time.perf_counter() - start
    if not memory:
        raise SystemExit(f"jaxmark {' '.join(words)} did nothing: {' '.join(said)[-500:]}")
    programs = [line.split(". Argument")[0] for line in said if "Compiling " in line and " with global shapes" in line]
    programs = [line[line.index("Compiling ") :] for line in programs]
    found: Row = {"seconds": seconds, "s a file": seconds / count, "refused": refused}
    return found | {"programs": len(programs), "kinds": len(set(programs)), "memory, GB": " ".join(memory)}


def measure(folder: Path, ways: dict[str, list[str]], words: dict[str, list[str]], alone: int) -> Iterator[Row]:
    """Work on a folder in each way, twice."""
    files = sorted((folder / "models").iterdir())
    key, processors = folder / "owner.key", os.cpu_count() or 1
    jm.watermark.save_key(jm.new_key(), key)
    for command, options in words.items():
        for turn in ("first", "second"):
            # A process each, of files of all sizes, with what it has in common with those before in the cache.
            some = files[:: max(1, len(files) // alone)]

            def one(file: Path, options: list[str] = options) -> None:
                named = [word.format(file=file, name=file.name, folder=folder, set="alone") for word in options]
                subprocess.run([*JAXMARK, *named], env=for_commands(folder / "alone"), capture_output=True, check=True)

            (folder / "marked alone").mkdir(exist_ok=True)
            start = time.perf_counter()
            with ThreadPoolExecutor(processors) as pool:
                list(pool.map(one, some))
            each = (time.perf_counter() - start) / len(some)
            yield {"command": command, "way": f"{processors} alone at a time", "run": turn, "s a file": each, "over": 1}
            for way, more in ways.items():
                named = [word.format(file=folder / "models", name="", folder=folder, set=way) for word in options]
                if command == "embed":
                    shutil.rmtree(folder / f"marked {way}", ignore_errors=True)
                row = run([*named, *more], folder / f"cache {way}", len(files))
                say(command, way, turn, f"{row['seconds']:.0f} s")
                yield {"command": command, "way": way, "run": turn, **row, "over": each / row["s a file"]}


def main() -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--count", type=int, default=200, help="files in the folder")
    parser.add_argument("--alone", type=int, default=20, help="files that are worked on by a process each")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, os.cpu_count() or 1])
    options = parser.parse_args()
    ways = {f"--workers {workers}": ["--workers", str(workers)] for workers in options.workers}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "models").mkdir()
        make_folder(folder / "models", options.meshes, options.count)
        key = ["--key", "{folder}/owner.key"]
        words = {
            "embed": ["embed", "{file}", "{folder}/marked {set}/{name}", *key, "--message", MESSAGE, "--overwrite"],
            "detect": ["detect", "{folder}/marked {set}/{name}", "--original", "{file}", *key],
        }
        print(table(list(measure(folder, ways, words, options.alone))))


if __name__ == "__main__":
    main()
