"""What a new user does: install into an empty environment, then run the README and the guides, and time the first mark.

Run by itself from a clone; pytest does not collect it.
"""

import re
import shlex
import shutil
import subprocess
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Go on with the README's mesh and key; that on strengths tunes for minutes, and is among the long tests.
GUIDES = ("study", "recipients", "arrays", "pictures")

MODEL = """
import trimesh
from jaxmark.app.demo import sample_mesh

trimesh.load(sample_mesh(), process=False).export("model.ply")
"""

FIRST = """
import time

seconds = time.time() - {start}
print(f"first mark read back after {{seconds:.0f}} s, installation included", flush=True)
assert detection.message == b"jaxmark!", detection
"""


def python_blocks(page: str) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def shell_lines(page: str) -> list[str]:
    """The lines from the shell, up to the first reading."""
    lines = re.findall(r"^    (jaxmark .*)$", page, re.MULTILINE)
    first = next(index for index, line in enumerate(lines) if line.startswith("jaxmark detect"))
    return lines[: first + 1]


def main() -> None:
    """Fail where README or guides do not work in an empty environment."""
    start = time.time()
    page = (ROOT / "README.md").read_text()
    guides = [(ROOT / "docs" / "how-to" / f"{name}.md").read_text() for name in GUIDES]
    lines = shell_lines((ROOT / "docs" / "reference" / "command_line.md").read_text())
    assert "pip install '.[all]'" in page
    assert [line for line in lines if line in shell_lines(page)] == shell_lines(page), "the README has other lines"
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder, "venv"), with_pip=True)
        python, jaxmark = (Path(folder, "venv", "bin", name) for name in ("python", "jaxmark"))
        subprocess.run([python, "-m", "pip", "install", "--quiet", ".[all]"], cwd=ROOT, check=True)
        print(f"installed after {time.time() - start:.0f} s", flush=True)
        first = [MODEL, *python_blocks(page), FIRST.format(start=start)]
        others = [block for guide in guides for block in python_blocks(guide)]
        Path(folder, "readme.py").write_text("\n".join([*first, *others]))
        subprocess.run([python, "readme.py"], cwd=folder, check=True)
        shell = Path(folder, "shell")  # a folder of its own, because existing files are refused
        shell.mkdir()
        shutil.copy(Path(folder, "model.ply"), shell)
        for line in lines:
            _, *arguments = shlex.split(line)
            print(line, flush=True)
            subprocess.run([jaxmark, *arguments], cwd=shell, check=True)
    print(f"README and guides were run after {time.time() - start:.0f} s")


if __name__ == "__main__":
    main()
