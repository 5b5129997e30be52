"""Marks are read after other programs have read and written the file."""

import importlib
from pathlib import Path

import pytest

tools = importlib.import_module("benchmarks.robustness.tools")  # by name, as these tests have a folder of it, too

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("unchecked")]


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory):
    return tools.prepare(tmp_path_factory.mktemp("marked"))


@pytest.mark.parametrize("case", tools.CASES, ids=lambda case: case.name)
def test_a_file_that_another_program_writes_is_read(case, subject, tmp_path: Path):
    try:
        row = tools.read(case, subject, tmp_path)
    except tools.MissingError as error:
        pytest.skip(str(error))
    if case.refused:
        assert row["message"].startswith("refused: ")
        assert case.refused in row["message"]
    else:
        assert row["message"] == "exact"
        assert float(row["log10 p"].partition(" ")[0]) < -6
