"""HTML documentation: it builds without warnings, covers the public code, and loads nothing from other sites."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_house import DOCS, HOUSE

from scenes.cli import COMMANDS
from scenes.episodes.episode import MEANINGS as EPISODE
from scenes.play.deformers import to_model_path
from scenes.script.scene import SCENES, find_scene
from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from surrogate.data.array_meanings import MEANINGS as DATASET
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw

FORMATS = (HOUSE / "docs/reference/formats.md").read_text()
LINKS = {"a": "href"}
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}


def build(source, target, *more):
    """Run Sphinx as `make docs` does."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", *more, source, target]
    return subprocess.run(command, cwd=HOUSE, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built pages, of a copy: what is generated lies beside the sources."""
    folder = tmp_path_factory.mktemp("pages")
    for name in ("docs", "examples"):
        shutil.copytree(HOUSE / name, folder / name, ignore=shutil.ignore_patterns("generated", "__pycache__"))
    for name in ("CHANGELOG.md", "CONTRIBUTING.md"):
        shutil.copy(HOUSE / name, folder)
    for gone in ("examples", "sim"):  # by an earlier build, of a script or a name that is there no more
        left = folder / f"docs/generated/{gone}/gone.rst"
        left.parent.mkdir(parents=True)
        left.write_text("Gone\n====\n")
    done = build(folder / "docs", folder / "site", "-D", "plot_gallery=0")  # examples are shown, not run
    assert done.returncode == 0, done.stderr
    return folder / "site"


class Tags(HTMLParser):
    """What a page holds: addresses that it loads, places that it links to, and its own anchors."""

    def __init__(self, page):
        super().__init__()
        self.loaded, self.links, self.anchors, self.names = set(), set(), set(), set()
        self.feed(page.read_text())

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.names.add(tag)
        self.anchors.add(given.get("id"))
        for kinds, found in ((LOADED, self.loaded), (LINKS, self.links)):
            if given.get(kinds.get(tag, "")):
                found.add(given[kinds[tag]])


@pytest.fixture(scope="module")
def pages(site):
    """Every page by its name."""
    return {path.relative_to(site).with_suffix("").as_posix(): Tags(path) for path in site.rglob("*.html")}


def test_every_source_and_example_has_a_page(pages):
    wanted = {path.relative_to(HOUSE / "docs").with_suffix("").as_posix() for path in DOCS}
    wanted |= {f"generated/examples/{path.stem}" for path in (HOUSE / "examples").glob("*.py")}
    assert len(wanted) > 20 and wanted <= set(pages)
    assert not {"generated/examples/gone", "generated/sim/gone"} & set(pages)


def test_every_example_has_its_own_image(site):
    shown = (site / "generated/examples/index.html").read_text()
    names = {path.stem for path in (HOUSE / "examples").glob("*.py")}
    images = {path.stem: path.read_bytes() for path in (HOUSE / "docs/examples").iterdir()}
    assert set(images) == names and len(set(images.values())) == len(names)
    assert max(map(len, images.values())) <= 15_000
    assert set(re.findall(r"sphx_glr_(\w+)_thumb\.webp", shown)) == names


def test_developer_page_links_the_contributing_guide(site, pages):
    assert "generated/contributing.html" in pages["develop"].links
    assert "Structure" in (site / "generated/contributing.html").read_text()


def test_pages_load_nothing_from_other_sites(site, pages):
    """No script, style, font or image: the pages are read without a network."""
    outside = {name: [it for it in page.loaded if "//" in it] for name, page in pages.items()}
    assert not {name: found for name, found in outside.items() if found}
    assert any(page.loaded for page in pages.values())
    styles = [path.read_text() for path in site.rglob("*.css")]
    assert styles and not [text for text in styles if re.search(r"(url\(|@import )['\"]?(https?:)?//", text)]


def test_every_internal_link_has_a_target(site, pages):
    checked = 0
    for name, page in pages.items():
        for link in page.links:
            place, _, anchor = link.partition("#")
            if re.match(r"[a-z]+:", link) or link == "#":
                continue
            target = (site / name).parent / place if place else site / f"{name}.html"
            assert target.exists(), f"{name} links to {link}"
            if anchor and target.suffix == ".html":
                assert anchor in pages[target.resolve().relative_to(site).with_suffix("").as_posix()].anchors, link
                checked += 1
    assert checked > 100


def test_reference_contains_every_command_and_public_name(site, pages, monkeypatch):
    monkeypatch.syspath_prepend(HOUSE / "docs/extensions")
    page_of = importlib.import_module("public_names").page_of
    for name in COMMANDS:
        assert (
            f"commands/{name}.html" in pages["generated/command-line"].links and f"generated/commands/{name}" in pages
        )
    text = "".join(path.read_text() for path in (site / "generated/commands").glob("*.html"))
    assert "--opening-over" in text and "FILE.py" in text and "python -m benchmarks throughput" in text
    for package in ("sim", "surrogate", "ar", "scenes"):
        names = importlib.import_module(package).__all__
        for name in names:
            page = page_of(package, name)
            assert f"{package}.{name}" in pages[f"generated/{package}/{page}"].anchors
            assert f"{package}/{page}.html#{package}.{name}" in pages[f"generated/{package}"].links
    assert len({page.lower() for page in pages}) == len(pages)  # files of other case are one on macOS and Windows


def test_formulas_are_mathml_without_mathjax(site, pages):
    assert "math" in pages["concepts/physics"].names
    assert "MathJax" not in (site / "concepts/physics.html").read_text()


def test_formats_page_describes_every_array(site):
    text = re.sub(r"<[^>]+>", "", (site / "reference/formats.html").read_text())
    assert not [name for name in (*DATASET, *EPISODE) if name not in text]


def test_code_on_formats_page_reads_the_files(tmp_path, monkeypatch, box, pretender):
    data, episode = re.findall(r"```python\n(.*?)```", FORMATS, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    simulate(Path("patient.h5"), pretender, draw("palpation", box, 6, 0), {"preset": "palpation"})
    names = {}
    exec(data, names)
    assert names["motion"].shape == (6, len(box.mesh.nodes), 3)
    held = set()
    with h5py.File("patient.h5") as file:
        file.visititems(lambda name, item: held.add(name) if isinstance(item, h5py.Dataset) else None)
    assert "loads/Pushed/force" in held and held <= set(DATASET)
    read = re.findall(r'file\["([\w/]+)"\]', episode)
    assert len(read) == 4 and set(read) <= set(EPISODE)


def test_formats_page_lists_the_contents_of_a_model():
    with np.load(to_model_path(get_template_path())) as archive:
        header = json.loads(str(archive["header"]))
    rows = re.findall(r"^\| (`\w+`) \| .*$", FORMATS.partition("\n## Model")[2].partition("\n## ")[0], re.M)
    held = {"tool" if name == "ball" else name for name in header["models"]["series-gp"]}  # this file is an older one
    assert {row.strip("`") for row in rows} == {"header", *held}
    (stated,) = re.findall(r"^\| `header` \| JSON: (.*)\|$", FORMATS, re.M)
    assert set(re.findall(r"`(\w+)`", stated)) == {"space", "seal", *header}
    (stated,) = re.findall(r"^\| `envelope` \| (.*)\|$", FORMATS, re.M)
    assert set(re.findall(r"`(\w+)`", stated)) == set(header["models"]["series-gp"]["envelope"])


def test_each_scene_has_an_image_and_a_heading():
    text = (HOUSE / "docs/scenes.md").read_text()
    assert re.findall(r"^## (\w+)\n\n!\[[^]]*\]\(scenes/(\w+)\.webp\)$", text, re.M) == [
        (name, name) for name in SCENES
    ]
    assert not [name for name in SCENES if find_scene(name).title not in text]
    pictures = list((HOUSE / "docs/scenes").glob("*.webp"))
    assert len(pictures) == len(SCENES) and sum(path.stat().st_size for path in pictures) < 400_000


def test_scene_displacements_agree_with_their_measurement():
    """They are measured again when the effects of a scene change."""
    text, measured = ((HOUSE / "docs" / name).read_text() for name in ("scenes.md", "scenes/measured.json"))
    known = json.loads(measured)
    assert f"`{known['command']}` computes them" in text
    assert [row["scene"] for row in known["scenes"]] == list(SCENES)
    anatomy = read_anatomy(get_template_path())
    for row in known["scenes"]:
        stated = re.search(rf"^\| \[{row['scene']}\].*\| ([\d.]+) \|$", text, re.MULTILINE)[1]
        assert float(stated) == round(row["moved_mm"], len(stated.partition(".")[2]))
        assert row["effects"] == [type(effect).__name__ for effect in find_scene(row["scene"]).get_effects_on(anatomy)]


@pytest.mark.parametrize(
    ("words", "title", "rest"),
    [
        ("Push on the brain.\n\nThen read.", "Push on the brain", "Then read."),
        ("Push on the brain\n\nThen: read. It.", "Push on the brain", "Then: read. It."),
        ("A law: Yeoh's, which\nstiffens.", "A law", "A law: Yeoh's, which\nstiffens."),
        ("Push\nhard. It |moves|.", "Push hard", "It \\|moves\\|."),
        ("Push at 0.3 N.", "Push at 0.3 N", ""),
    ],
)
def test_start_of_example_docstring_becomes_its_title(words, title, rest, monkeypatch):
    monkeypatch.syspath_prepend(HOUSE / "docs/extensions")
    made = importlib.import_module("example_scripts").gallery_script(f'"""{words}"""\nx = 1\n')
    assert made == f'r"""\n{title}\n{"=" * len(title)}\n\n{rest}\n"""\nx = 1\n'


def test_page_with_a_broken_link_fails_to_build(tmp_path):
    """Warnings are errors: here of one page, with the settings of all."""
    shutil.copytree(HOUSE / "docs/extensions", tmp_path / "extensions")
    settings = (HOUSE / "docs/conf.py").read_text()
    for gone in ('    "generated_pages",\n', '    "sphinx_gallery.gen_gallery",\n'):
        assert gone in settings
        settings = settings.replace(gone, "")
    (tmp_path / "conf.py").write_text(settings)
    (tmp_path / "static").mkdir()
    (tmp_path / "static/pages.css").write_text("")
    (tmp_path / "index.md").write_text("# A page\n\n$E^2$\n")
    assert build(tmp_path, tmp_path / "site").returncode == 0
    (tmp_path / "index.md").write_text("# A page\n\n[x](nowhere.md)\n\n$\\no$\n")
    refused = build(tmp_path, tmp_path / "site")
    assert refused.returncode == 1 and "nowhere.md" in refused.stderr and "\\no" in refused.stderr, refused.stderr
