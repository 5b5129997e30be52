"""Mark, attack and read all mesh files of a folder by the command line, and load them by another program.

The program runs the commands `embed`, `detect`, `attack` and `detect` on each file, each as a process with limits of
time and memory. The attack is noise of half the strength that, by `embed`, the mark survives. A file counts as marked
if the message can be read from every mesh that `embed` marked, each alone; of equal meshes, which count once, one is
enough. trimesh loads the source and the marked file, and must find the same meshes, displaced by no more than `embed`
printed. The outcome of each file is a line of `results.jsonl` in the output folder; files with a line are not run
again. The output is a table by format, all refusals with their reasons, and all failures.

    python benchmarks/robustness/assets.py FOLDER --output RESULTS
"""

import collections
import functools
import json
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import jaxmark as jm
from jaxmark.files import SUFFIXES

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import make_parser
from common.marks import KEY, MESSAGE
from common.tables import Row, say, table

COMMAND = [sys.executable, "-m", "jaxmark"]
OUTCOMES = ("marked", "lost", "refused", "wrong")


def limit(memory: float) -> None:
    """Limit the memory of this process, in GiB."""
    most = int(memory * 2**30)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def run(arguments: list[object], seconds: float, memory: float) -> tuple[int, dict[str, Any], str]:
    """Run a command; returns its status, what it answered, and what it said on standard error."""
    try:
        done = subprocess.run(
            [*COMMAND, *map(str, arguments), "--json"],
            capture_output=True,
            text=True,
            timeout=seconds,
            preexec_fn=functools.partial(limit, memory),
        )
    except subprocess.TimeoutExpired:
        return 124, {}, f"longer than {seconds:g} s"
    answer = json.loads(done.stdout) if done.returncode in (0, 1) and done.stdout else {}
    return done.returncode, answer, done.stderr.strip()


def is_foreign(said: str) -> bool:
    """Whether something else than a refusal was said."""
    return "Unexpected" in said or "Traceback" in said


def differences(source: Path, marked: Path, most: float) -> str:
    """What trimesh sees that should not be; nothing if all is well.

    Args:
        source: the file.
        marked: the marked file.
        most: the largest displacement, in diagonals of its mesh.
    """
    try:
        before = trimesh.load_scene(source, process=False).geometry
    except Exception:  # what it does not load, it need not load when marked
        return ""
    after = trimesh.load_scene(marked, process=False).geometry
    if list(before) != list(after):
        return f"other meshes: {list(before)[:3]} and {list(after)[:3]}"
    whole = float(np.linalg.norm(np.ptp(np.concatenate([one.vertices for one in before.values()]), axis=0)))
    for name, old in before.items():
        new = after[name]
        if np.shape(old.vertices) != np.shape(new.vertices):
            return f"{name}: other numbers of vertices"
        if isinstance(old, trimesh.Trimesh):
            if not np.array_equal(old.faces, new.faces):
                return f"{name}: other faces"
            texture, again = (getattr(one.visual, "uv", None) for one in (old, new))
            if texture is not None and not (again is not None and np.array_equal(texture, again)):
                return f"{name}: other texture coordinates"
        # A part of a mesh is smaller than the mesh, whose diagonal counts, and that is smaller than all of the file.
        moved = np.linalg.norm(np.asarray(old.vertices) - new.vertices, axis=1).max(initial=0.0)
        if moved > 1.05 * most * whole + 1e-6 * whole:
            return f"{name}: moved by {moved / whole:.2g} of the file's diagonal"
    return ""


def try_file(path: Path, seconds: float, memory: float) -> dict[str, Any]:
    """Mark, attack and read one file."""
    begin = time.monotonic()
    found: dict[str, Any] = {"suffix": path.suffix.lower(), "bytes": path.stat().st_size}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        key, marked, suspect = folder / "key", folder / f"marked{path.suffix}", folder / f"suspect{path.suffix}"
        jm.watermark.save_key(jm.Key(KEY), key)
        call = functools.partial(run, seconds=seconds, memory=memory)
        status, told, said = call(["embed", path, marked, "--key", key, "--message", MESSAGE.hex()])
        if status != 0:
            outcome = "wrong" if status != 2 or is_foreign(said) else "refused"
            return found | {"outcome": outcome, "why": said[-600:], "seconds": time.monotonic() - begin}
        found |= {"meshes": len(told.get("meshes", [0])), "left": len(told.get("left", [])), "max": told["max"]}
        read = ["--original", path, "--key", key, "--record", told["record"]]
        status, seen, said = call(["detect", marked, *read])
        alone = [one["detected"] for one in seen.get("meshes", {}).values()]
        good = status == 0 and seen.get("message") == MESSAGE.hex() and all(alone)
        found["why"] = (said[-600:] if is_foreign(said) else "") or differences(path, marked, told["max"])
        survives = [one["survives"] for one in told["meshes"].values()] if "meshes" in told else [told["survives"]]
        noise = min(one["whole"] for one in survives) / 2
        if good and noise > 0:
            status, _, said = call(["attack", marked, suspect, "noise", noise])
            if status and is_foreign(said):
                found["why"] = found["why"] or said
            status, seen, _ = call(["detect", suspect, *read])
            found["attacked"] = status == 0 and seen.get("message") == MESSAGE.hex()
        found["noise"] = 2 * noise
        found["outcome"] = "lost" if not good else "wrong" if found["why"] else "marked"
    return found | {"seconds": time.monotonic() - begin}


def reason(said: str) -> str:
    """A refusal without what differs from file to file."""
    plain = re.sub(r"^jaxmark: \S+: |'[^']*'|[0-9.e+-]+", "…", said)
    return plain[:110]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path, default=Path("assets-output"))
    parser.add_argument("--processes", type=int, default=1, help="files at a time")
    parser.add_argument("--seconds", type=float, default=600, help="for each command")
    parser.add_argument("--memory", type=float, default=8, help="GiB for each command")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    results = arguments.output / "results.jsonl"
    rows: dict[str, dict[str, Any]] = {}
    if results.exists():
        for text in results.read_text().splitlines():
            rows |= json.loads(text)
    files = sorted(path for path in arguments.folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    lock = threading.Lock()

    def work(path: Path) -> None:
        name = str(path.relative_to(arguments.folder))
        if name in rows:
            return
        row = try_file(path, arguments.seconds, arguments.memory)
        with lock, results.open("a") as file:
            rows[name] = row
            file.write(json.dumps({name: row}) + "\n")
            say(f"{name}: {row['outcome']}, {row['seconds']:.0f} s {row['why'][:200]}")

    with ThreadPoolExecutor(arguments.processes) as pool:
        list(pool.map(work, files))
    names = {str(path.relative_to(arguments.folder)) for path in files}
    rows = {name: row for name, row in rows.items() if name in names}
    report(rows)


def report(rows: dict[str, dict[str, Any]]) -> None:
    """Print the table, and what was refused or went wrong."""
    lines: list[Row] = []
    for suffix in [*sorted({row["suffix"] for row in rows.values()}), "all"]:
        own = [row for row in rows.values() if suffix in (row["suffix"], "all")]
        counts = collections.Counter(row["outcome"] for row in own)
        attacked = [row["attacked"] for row in own if "attacked" in row]
        each = {name: counts[name] for name in OUTCOMES}
        both = f"{sum(attacked)} of {len(attacked)}"
        lines.append({"format": suffix, "files": len(own), **each, "read after half the noise": both})
    print(table(lines))
    for kind in ("refused", "lost", "wrong"):
        whys = collections.Counter(reason(row["why"]) for row in rows.values() if row["outcome"] == kind)
        for why, count in whys.most_common():
            print(f"{kind}, {count}: {why}")


if __name__ == "__main__":
    main()
