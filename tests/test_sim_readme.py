"""The README's Python example runs as it stands, on any anatomy."""

import re
from pathlib import Path

import numpy as np
import pytest

from scenes.shipped import template_path
from sim.deformation import Outcome
from sim.meshfile import read_anatomy, write_anatomy


def example():
    """The code of the README's one Python block."""
    (code,) = re.findall(r"```python\n(.*?)```", (Path(__file__).parents[1] / "README.md").read_text(), re.DOTALL)
    return code


@pytest.mark.parametrize("body", ["box", "template"])
def test_the_example_runs_as_it_stands(body, box, tmp_path, monkeypatch, capsys):
    anatomy = box if body == "box" else read_anatomy(template_path())
    write_anatomy(tmp_path / "patient.vtu", anatomy)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(example(), "README.md", "exec"), names)
    answer = names["answer"]
    assert answer.outcome == (Outcome.CONVERGED,) and np.array_equal(answer.nodes, anatomy.tumour_nodes)
    # The tumour goes in, with the tool.
    assert 1e-4 < (answer.displacement[0] @ names["place"].inward).mean() < 5e-3
    assert "converged" in capsys.readouterr().out
