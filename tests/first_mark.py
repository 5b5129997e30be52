"""What a new user does: install into an empty environment, then run the README, and how long the first mark takes.

Run by itself from a clone; pytest does not collect it.
"""

import re
import shlex
import subprocess
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST = 300.0  # s, to the first mark read back

MODEL = """
import trimesh
from jaxmark.demo import sample_mesh

trimesh.load(sample_mesh(), process=False).export("model.ply")
"""

FIRST = """
import time

seconds = time.time() - {start}
print(f"first mark read back after {{seconds:.0f}} s, installation included", flush=True)
assert found.message == bytes.fromhex("0123456789abcdef"), found
assert seconds < {longest}, "the first mark took too long"
"""


def python_blocks(page: str) -> list[str]:
    """The Python blocks of the README."""
    return re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def shell_lines(page: str) -> list[str]:
    """The lines from the shell, up to the first reading."""
    lines = re.findall(r"^    (jaxmark .*)$", page, re.MULTILINE)
    first = next(index for index, line in enumerate(lines) if line.startswith("jaxmark detect"))
    return lines[: first + 1]


def main() -> None:
    """Fail where the README does not work in an empty environment, or takes too long."""
    start = time.time()
    page = (ROOT / "README.md").read_text()
    assert "`pip install '.[all]'`" in page
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder, "venv"), with_pip=True)
        python, jaxmark = (Path(folder, "venv", "bin", name) for name in ("python", "jaxmark"))
        subprocess.run([python, "-m", "pip", "install", "--quiet", ".[all]"], cwd=ROOT, check=True)
        print(f"installed after {time.time() - start:.0f} s", flush=True)
        first, *others = python_blocks(page)
        script = [MODEL, first, FIRST.format(start=start, longest=LONGEST), *others]
        Path(folder, "readme.py").write_text("\n".join(script))
        subprocess.run([python, "readme.py"], cwd=folder, check=True)
        for line in shell_lines(page):
            _, *arguments = shlex.split(line)
            print(line, flush=True)
            subprocess.run([jaxmark, *arguments], cwd=folder, check=True)
    print(f"the README was run after {time.time() - start:.0f} s")


if __name__ == "__main__":
    main()
