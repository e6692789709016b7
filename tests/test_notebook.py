from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path("docs/notebooks/recording.ipynb")

_read: Callable[..., Any] = nbformat.read


@pytest.mark.slow
def test_the_example_notebook_runs() -> None:
    """From end to end, in a kernel of its own, and draws its pictures."""
    notebook = _read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(NOTEBOOK.parent)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert [output.text for output in outputs if output.output_type == "stream"] == []


def test_no_outputs_are_kept() -> None:
    for cell in _read(NOTEBOOK, as_version=4).cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
