"""Container recipe: instructions, copied files, documented commands, and a build."""

import ast
import os
import re
import shutil
import subprocess
import tomllib

import pytest
from test_house import HOUSE

from scenes.cli import make_parsers

TEXT = (HOUSE / "Containerfile").read_text()
LINES = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", TEXT, flags=re.MULTILINE)).splitlines()
STEPS = [tuple(line.split(maxsplit=1)) for line in LINES if line.strip()]
"""Instructions and their arguments."""
COPIED = [name for step, rest in STEPS if step == "COPY" for name in rest.split()[:-1]]
PAGE = (HOUSE / "docs/install.md").read_text().partition("## Container")[2].partition("\n## ")[0]
ENGINE = next((name for name in ("podman", "docker") if shutil.which(name)), None)


def find(step):
    """Arguments of an instruction."""
    return [rest for name, rest in STEPS if name == step]


def test_container_base_has_a_pinned_version():
    (base,) = find("FROM")
    assert re.fullmatch(r"python:3\.11\.\d+-slim-[a-z]+", base)


def test_container_contains_no_external_url():
    assert {name for name, _ in STEPS} == {"FROM", "ARG", "ENV", "WORKDIR", "COPY", "RUN", "USER", "EXPOSE", "CMD"}
    assert set(re.findall(r"\w+://[^\s\"/]+", TEXT)) == {"http://localhost:8080"}
    assert not re.search(r"(?:docker|quay|ghcr)\.io|pypi\.org|download\.", TEXT)


def test_container_runs_without_root():
    names = [name for name, _ in STEPS]
    (user,) = find("USER")
    assert user == "sulcus" and f"useradd --create-home {user}" in find("RUN")[-1]
    assert "RUN" not in names[names.index("USER") :]


def test_container_copies_the_files_of_the_package():
    project = tomllib.loads((HOUSE / "pyproject.toml").read_text())
    packages = {name for name in project["tool"]["setuptools"]["packages"]["find"]["include"] if "." not in name}
    files = {"pyproject.toml", "constraints.txt", project["project"]["readme"], *project["project"]["license-files"]}
    assert set(COPIED) == packages | files and all((HOUSE / name).exists() for name in COPIED)
    ignore = (HOUSE / ".dockerignore").read_text().splitlines()
    assert "*" in ignore and {line[1:] for line in ignore if line.startswith("!")} == set(COPIED)


def test_container_serves_the_page_to_its_host_only():
    (command,) = find("CMD")
    program, *words = ast.literal_eval(command)
    args = make_parsers(words[0])[0].parse_args(words)
    assert program == "sulcus" and args.command == "demo" and args.host == "0.0.0.0"
    assert args.address == [f"http://localhost:{args.port}"] and find("EXPOSE") == [str(args.port)]
    published = re.findall(r"(?:--publish|-p) (\S+)", PAGE)
    assert published and set(published) == {f"127.0.0.1:{args.port}:{args.port}"}
    assert "--file Containerfile" in PAGE and "--build-arg PIP_EXTRA_INDEX_URL=" in PAGE


@pytest.mark.timeout(1800)
def test_container_builds_and_prints_its_version():
    index = os.environ.get("SULCUS_TORCH_CPU_INDEX")
    if index is None:
        pytest.skip("needs SULCUS_TORCH_CPU_INDEX, the index that pytorch.org names for CPU builds")
    if ENGINE is None or subprocess.run([ENGINE, "info"], capture_output=True, check=False).returncode:
        pytest.skip("no container engine runs")
    build = ["build", "--build-arg", f"PIP_EXTRA_INDEX_URL={index}", "--file", "Containerfile", "--tag", "sulcus:test"]
    subprocess.run([ENGINE, *build, "."], cwd=HOUSE, check=True)
    shown = subprocess.run(
        [ENGINE, "run", "--rm", "sulcus:test", "sulcus", "--version"], capture_output=True, text=True, check=True
    )
    assert shown.stdout.startswith("sulcus 0.")
