"""The README's Python example runs unchanged; files that the pages name exist."""

import re

import numpy as np
import pytest
from test_house import DOCS, HOUSE

from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.deformation import Outcome

PAGES = [HOUSE / "README.md", *sorted(DOCS)]


def example():
    """The code of the README's one Python block."""
    (code,) = re.findall(r"```python\n(.*?)```", (HOUSE / "README.md").read_text(), re.DOTALL)
    return code


@pytest.mark.parametrize("body", ["box", "template"])
def test_readme_example_runs_unchanged(body, box, tmp_path, monkeypatch, capsys):
    anatomy = box if body == "box" else read_anatomy(get_template_path())
    write_anatomy(tmp_path / "patient.vtu", anatomy)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(example(), "README.md", "exec"), names)
    answer = names["answer"]
    assert answer.outcome == (Outcome.CONVERGED,) and np.array_equal(answer.nodes, anatomy.tumour_nodes)
    # The tumour goes in, with the tool.
    assert 1e-4 < (answer.displacement[0] @ names["place"].inward).mean() < 5e-3
    assert "converged" in capsys.readouterr().out


def test_readme_is_at_most_8_kib():
    assert len((HOUSE / "README.md").read_bytes()) <= 8192


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_links_and_files_of_a_page_exist(page):
    text = page.read_text()
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", text)]
    missing = [link for link in links if link and not (page.parent / link).exists()]
    files = re.findall(r"`((?:sim|surrogate|ar|scenes|tests|examples)/[\w/]+\.py)`", text)
    assert not missing + [file for file in files if not (HOUSE / file).exists()]
