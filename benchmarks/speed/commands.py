"""Time whole commands on files, with default options, stage by stage: python benchmarks/speed/commands.py MESH...

`jaxmark embed` and `jaxmark detect` run as processes, twice each with the same cache of compiled programs, which is
empty before the first run. The table has a line for each run: seconds of each stage without the stages inside it, of
the whole process, and of compiling programs or loading them from the cache, the number of programs, and the peak
memory.

start    until the command line is parsed: interpreter and imports
read     files, each time that one is read
prepare  the original: welding, hashing, Laplacian, masking, carrier
limits   visibility of trial displacements
write    the rest of writing the mark
back     reading the written file, and measuring the noise that the mark survives
save     the marked file
align    the suspect with the original
receive  weighting of bands, and evidence
other    the rest
"""

import argparse
import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.tables import say, table
from common.timing import Compilation, for_commands

BORN = time.time()
# The functions of each stage: module, name, and stage.
FUNCTIONS = (
    ("jaxmark.app.mark_files", "load_scene", "read"),
    ("jaxmark.app.mark_files", "load_mesh", "read"),
    ("jaxmark.app.mark_files", "load_texture", "read"),
    ("jaxmark.app.read_files", "load_scene", "read"),
    ("jaxmark.app.read_files", "load_mesh", "read"),
    ("jaxmark.app.mark_files", "prepare", "prepare"),
    ("jaxmark.app.read_files", "alternatives", "prepare"),
    ("jaxmark.app.read_files", "make_marker", "prepare"),
    ("jaxmark.distortion", "Reference.measure", "limits"),
    ("jaxmark.watermark.markers", "NonBlindMarker.adapted", "write"),
    ("jaxmark.watermark.markers", "NonBlindMarker.embed", "write"),
    ("jaxmark.watermark.markers", "NonBlindMarker.reads", "back"),
    ("jaxmark.watermark.markers", "NonBlindMarker.measure_survival", "back"),
    ("jaxmark.app.mark_files", "save_mesh", "save"),
    ("jaxmark.alignment.attempts", "align", "align"),
    ("jaxmark.watermark.nonblind", "Alternatives.read", "receive"),
)
STAGES = ("start", *dict.fromkeys(stage for *_, stage in FUNCTIONS), "other")


class Watch:
    """Seconds of each stage, without those of stages that run in it."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._running = ["start"]
        # The interpreter's own start is counted from when the parent started it.
        self._since = time.perf_counter() - (time.time() - float(os.environ.get("STARTED", BORN)))

    def switch(self) -> None:
        """Book what passed since the last switch on the stage that runs."""
        now = time.perf_counter()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Run a stage."""
        self.switch()
        self._running.append(name)
        try:
            yield
        finally:
            self.switch()
            self._running.pop()

    def wrap(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """The function as a stage."""

        @wraps(function)
        def watched(*arguments: Any, **options: Any) -> Any:
            with self.stage(name):
                return function(*arguments, **options)

        return watched


def run_inside(result: Path) -> None:
    """Run the command line with its functions watched, and leave what was seen in a file."""
    watch, compilation = Watch(), Compilation()
    from jaxmark.app.start import main

    for module, names, stage in FUNCTIONS:
        *owners, name = names.split(".")
        owner: Any = importlib.import_module(module)
        for one in owners:
            owner = getattr(owner, one)
        setattr(owner, name, watch.wrap(getattr(owner, name), stage))
    try:
        with watch.stage("other"):
            main()
    finally:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        compiled = {"compiling, s": compilation.seconds, "programs": compilation.programs}
        result.write_text(json.dumps({"seconds": watch.seconds, "compiled": compiled, "peak": peak}))


def run(words: list[str], cache: Path) -> dict[str, Any]:
    """Run one command as a process."""
    result = cache / "stages.json"
    program = [sys.executable, str(Path(__file__).resolve()), "--inside", str(result), *words]
    start = time.time()
    environment = {**for_commands(cache), "STARTED": str(start)}
    done = subprocess.run(program, env=environment, capture_output=True, text=True)
    if done.returncode > 1 or not result.exists():
        raise SystemExit(f"jaxmark {' '.join(words)} ended with {done.returncode}: {done.stderr[-500:]}")
    found = json.loads(result.read_text())
    shown = {stage: round(found["seconds"][stage], 2) for stage in STAGES}
    return {**shown, "seconds": time.time() - start, **found["compiled"], "peak, GB": found["peak"] / 1e9}


def measure(mesh: Path, options: list[str]) -> Iterator[dict[str, Any]]:
    """Mark and read one file, twice."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        key, marked = place / "owner.key", place / f"marked{mesh.suffix}"
        run(["keygen", str(key)], place)
        embed = ["embed", str(mesh), str(marked), "--key", str(key), "--message", "0123456789abcdef", *options]
        record = Path(f"{marked}.jaxmark.json")
        detect = ["detect", str(marked), "--original", str(mesh), "--key", str(key)]
        for number, words in (("first", embed), ("second", embed), ("first", detect), ("second", detect)):
            if words is embed:
                marked.unlink(missing_ok=True)
                record.unlink(missing_ok=True)
            found = run(words, place)
            say(mesh.name, words[0], number, f"{found['seconds']:.1f} s")
            megabytes = mesh.stat().st_size / 1e6
            yield {"mesh": mesh.name, "file, MB": megabytes, "command": words[0], "run": number, **found}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path, metavar="MESH")
    parser.add_argument("--options", default="", help="more options of embed, in one word")
    arguments = parser.parse_args()
    rows = [row for mesh in arguments.meshes for row in measure(mesh, arguments.options.split())]
    print(table(rows))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        inside, sys.argv = Path(sys.argv[2]), ["jaxmark", *sys.argv[3:]]
        run_inside(inside)
    else:
        main()
