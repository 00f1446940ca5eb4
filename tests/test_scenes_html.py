"""Page in one file: its model and outline against Python, and its controls."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import PROGRAM, SIZES, Chromium

from ar.overlay.hud import format_bound as words
from ar.overlay.outlines import compute_silhouette, find_outlines
from scenes.cli import main
from scenes.html.document import MAX_BYTES, SCRIPTS, build_exported_model, build_html, choose_model
from scenes.html.packing import pack_arrays
from scenes.play.deformers import open_theatre
from scenes.play.frame_text import OUTCOME_WARNINGS
from scenes.play.player import BONE_WARNING
from scenes.script.scene import find_scene
from scenes.script.tool_paths import Touch
from sim.deformation import Outcome
from sim.errors import InputError
from sim.loads import Pushed, push
from surrogate.data.tool_loads import draw

FOLDER = Path(__file__).parents[1] / "scenes/html"
NODE = shutil.which("node")
AGREEMENT = 1e-8  # [m]: 1e-5 mm
LOADS = 1000
# Answers of the page's own functions to the loads of a file, in Node.
HARNESS = """
const fs = require("fs"), text = fs.readFileSync(process.argv[2], "utf8");
const part = (id) => text.match(new RegExp(`id="${id}">([^<]*)<`))[1], scene = JSON.parse(part("scene"));
const loads = JSON.parse(fs.readFileSync(0));
openModel(scene, part("arrays")).then((model) => console.log(JSON.stringify(answers(model, loads))));
"""
ANSWERS = """
function answers({ solve, arrays }, loads) {
  return loads.map(([point, force, footprint]) => {
    const { displacement, bound, extrapolated } = solve(point, force, footprint);
    return [[...arrays.tumourRows].map((row) => [...displacement.data.slice(3 * row, 3 * row + 3)]), ...bound.data,
      extrapolated.data[0]];
  });
}
"""


@pytest.fixture(scope="module")
def theatre():
    return open_theatre(device="cpu")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "press.html"
    assert main(["export", "--to", "html", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def window(page):
    if PROGRAM is None:
        pytest.skip("there is no Chromium here")
    window = Chromium()
    window.open(page.as_uri(), *SIZES[1])
    assert window.wait("window.sulcus") and window.value("sulcus.then((found) => { window.page = found; return 1 })")
    assert window.wait("page.state.edge"), window.errors
    yield window
    window.close()


def settle(window, script):
    """Run a script, and wait for the image that shows its effect with all pixels."""
    window.value(f"{script}; page.state.sharp = false")
    assert window.wait("!page.state.dirty && page.state.sharp")


def sampled(anatomy):
    """Loads like those of the training, and stronger ones."""
    loads = draw("palpation", anatomy, LOADS, 11).get(Pushed)
    force = loads.force * np.where(np.arange(LOADS) % 10 == 0, 2.0, 1.0)[:, None]
    return push(loads.point, force, loads.footprint)


def assert_alike(answer, wanted):
    moved, first, second, outside = zip(*answer, strict=True)
    assert np.abs(np.array(moved) - wanted.displacement).max() <= AGREEMENT
    assert np.allclose([first, second], wanted.bound, rtol=1e-9, atol=0.0)
    assert [bool(each) for each in outside] == [each is Outcome.EXTRAPOLATED for each in wanted.outcome]
    assert 10 < sum(outside) < LOADS - 10


@pytest.mark.parametrize(("name", "cortex"), [("ann", True), ("ann", False), ("svr", True), ("linear", True)])
def test_html_page_predicts_as_the_python_model(theatre, tmp_path, name, cortex):
    if NODE is None:
        pytest.skip("node is not installed")
    out, script = tmp_path / "page.html", tmp_path / "harness.js"
    exported = build_exported_model(name, theatre.models[name], cortex)
    out.write_text(build_html(theatre, find_scene("press"), exported))
    parts = [(FOLDER / each).read_text() for each in SCRIPTS[:3]]
    script.write_text("\n".join([*parts, ANSWERS, HARNESS]))
    loads = sampled(theatre.anatomy)
    pushed, nodes = loads.get(Pushed), np.unique(theatre.anatomy.tumour_surface)
    given = list(zip(pushed.point.tolist(), pushed.force.tolist(), pushed.footprint.tolist(), strict=True))
    done = subprocess.run(
        [NODE, script, out], input=json.dumps(given), capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert_alike(json.loads(done.stdout), theatre.models[name].deform(loads, at=nodes))


def test_html_page_is_small_and_loads_no_resources(page):
    text = page.read_text(encoding="ascii")
    assert len(text) <= MAX_BYTES and len(SCRIPTS) == len(list(FOLDER.glob("*.js")))
    assert not re.search(r"https?:|//\w+\.\w+/|\bimport\b|src=|href=|url\(", text)
    assert "default-src 'none'" in text and "Not a medical device" in text
    assert "Copyright (C) 1993-2004 Louis Collins" in text  # the notice of the template's brain
    assert sum((FOLDER / each).read_text().count("\n") for each in SCRIPTS) <= 800


def test_html_page_escapes_names(theatre):
    bad = "</script><img src=x>"
    model = replace(theatre.models["ann"], training={**theatre.models["ann"].training, "learner": bad})
    other = replace(theatre, models={bad: model})
    scene = replace(find_scene("press"), name=bad, title=f"{bad}$title")
    text = build_html(other, scene, choose_model(other))
    assert bad not in text and "&lt;img src=x&gt;$title" in text


def test_arrays_are_packed_with_their_types():
    arrays = {"a": np.array([[1.5, -2.0]]), "b": np.arange(3), "c": np.array([True, False]), "d": np.float32([0.1])}
    table, text = pack_arrays(arrays)
    assert {name: kind for name, (kind, _) in table.items()} == {"a": "f8", "b": "i4", "c": "u1", "d": "f4"}
    assert table["a"][1] == (1, 2) and base64.b64decode(text)


def distances_to(points, outline):
    """Distance of each point (n, 2) from a closed line (m, 2) [pixel]."""
    step = np.roll(outline, -1, axis=0) - outline
    arm = points[:, None] - outline
    share = np.clip((arm * step).sum(axis=2) / np.maximum((step**2).sum(axis=1), 1e-12), 0.0, 1.0)
    return np.linalg.norm(arm - share[..., None] * step, axis=2).min(axis=1)


def outline_of(player, touch, scale):
    """Outline (m, 2) of the tumour by Python's model, camera and rasteriser, `scale` times as large as its image."""
    answer = player.compute_deformation(player.scene.build_loads(player.site, touch, 0.0))
    tumour, camera = player.stage.build_tumour(player.compute_positions(answer)), player.camera
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += 0.5 * (scale - 1.0)  # whole numbers are at pixel centres
    larger = replace(camera, K=K, width=round(scale * camera.width), height=round(scale * camera.height))
    (outline,) = find_outlines(compute_silhouette(larger, tumour.vertices, tumour.triangles))
    return (outline[:, 0] + 0.5) / scale - 0.5


@pytest.mark.parametrize(("x", "y", "force"), [(0.0, 0.0, 0.3), (4e-3, -5e-3, 0.35), (-6e-3, 3e-3, 0.2)])
def test_html_page_outline_matches_python_projection(theatre, window, x, y, force):
    player = theatre.build_player("ann", find_scene("press"))
    settle(window, f"page.moveTo({x}, {y}); page.press({force})")
    edge = np.array(window.value("page.state.edge"))
    view, camera = window.value("page.state.view"), player.camera
    scale = view["focal"] / camera.K[0, 0]
    seen = (edge - view["centre"]) / scale + camera.K[:2, 2]
    wanted = outline_of(player, Touch(x, y, force), 4.0)
    assert distances_to(seen, wanted).mean() < 0.5 and distances_to(wanted, seen).mean() < 0.5
    # On the screen: pixels of the outline's colour.
    shot = cv2.imdecode(np.frombuffer(window.shot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    inked = (np.abs(shot - np.rint(255 * np.array(window.value("page.scene.inks.tumour")))) < 12).all(axis=2)
    inked[:, window.value("page.state.view.ratio * document.querySelector('canvas').clientWidth | 0") :] = False
    row, column = np.nonzero(inked)
    drawn = (np.column_stack([column, row]) + 0.5 - view["centre"]) / scale + camera.K[:2, 2]
    assert len(drawn) > 800 and distances_to(drawn, wanted).mean() < 1.0
    moved = player.draw(0, 0.0, Touch(x, y, force))
    text = window.value("document.getElementById('result').textContent")
    assert text == f"tumour moved {1e3 * moved.moved:.2f} mm (model error \u2264 {words(moved.model_error, 2)})"
    assert words(moved.tumour_error.bound, 1) in window.value("document.getElementById('position').textContent")


def test_html_page_instrument_tip_equals_python(theatre, window):
    player = theatre.build_player("ann", find_scene("press"))
    for x, y, force in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.38), (7e-3, 5e-3, 0.2)):
        settle(window, f"page.moveTo({x}, {y}); page.press({force})")
        tip = player.draw(0, 0.0, Touch(x, y, force)).tip
        assert np.linalg.norm(np.array(window.value("page.state.result.tip")) - tip) < 0.1e-3


def test_html_page_marks_load_outside_training_range(theatre, window):
    settle(window, "page.moveTo(0, 0); page.press(0.5)")
    assert window.value("document.getElementById('doubt').textContent") == OUTCOME_WARNINGS[Outcome.EXTRAPOLATED]
    assert "error not known" in window.value("document.getElementById('result').textContent")
    assert window.value("document.body.className") == "doubtful"
    assert window.value("page.scene.words.blocked") == BONE_WARNING
    settle(window, "page.press(0.3)")
    assert window.value("document.body.className + document.getElementById('doubt').textContent") == ""


def test_pointer_keys_and_wheel_move_the_tool_in_html_page(window):
    settle(window, "page.moveTo(0, 0); page.press(0.3)")
    place = "(p => [p[0] / page.state.view.ratio, p[1] / page.state.view.ratio])"
    contact = f"{place}(page.project(page.state.result.contact.point, page.state.view))"
    column, row = window.value(contact)
    for what, x, y in (
        ("mousePressed", 0, 0),
        ("mouseMoved", 10, -10),
        ("mouseMoved", 30, -40),
        ("mouseReleased", 30, -40),
    ):
        window.ask(
            "Input.dispatchMouseEvent", type=what, x=column + x, y=row + y, button="left", buttons=1, clickCount=1
        )
    settle(window, "0")
    assert np.allclose(window.value(contact), [column + 30, row - 40], atol=2.0)
    settle(window, "page.moveTo(0, 0)")
    for key, code in (("ArrowRight", "ArrowRight"), ("ArrowUp", "ArrowUp"), ("ArrowUp", "ArrowUp"), ("+", "Equal")):
        window.press(key, code)
    settle(window, "0")
    assert np.allclose(window.value("[page.state.x, page.state.y, page.state.force]"), [1e-3, 2e-3, 0.32])
    window.ask("Input.dispatchMouseEvent", type="mouseWheel", x=column, y=row, deltaX=0, deltaY=100)
    assert window.wait("Math.abs(page.state.force - 0.3) < 1e-9")
    settle(window, "page.moveTo(1, 0)")
    assert np.isclose(window.value("page.state.x"), window.value("page.scene.frame.reach"))


@pytest.mark.parametrize("size", [SIZES[0], SIZES[1], SIZES[3]], ids=lambda size: f"{size[0]}x{size[1]}")
def test_html_page_fits_the_window(window, size):
    window.size(*size)
    assert window.wait(f"innerWidth == {size[0]}")
    settle(window, "page.moveTo(0, 0); page.press(0.3)")
    whole = "document.documentElement"
    assert max(window.value(f"[{whole}.scrollWidth - innerWidth, {whole}.scrollHeight - innerHeight]")) <= 0
    boxes = "['view', 'result', 'position', 'force'].map((id) => document.getElementById(id).getBoundingClientRect())"
    for left, top, right, bottom in window.value(f"{boxes}.map((b) => [b.left, b.top, b.right, b.bottom])"):
        assert 0 <= left < right <= size[0] and 0 <= top < bottom <= size[1]
    assert not window.errors
    window.size(*SIZES[1])


def test_export_rejects_options_unsuitable_for_html(theatre, page, tmp_path, capsys):
    out = str(tmp_path / "page.html")
    for given, said in (
        (["--out", str(page)], "exists. Give --force"),
        (["--out", out, "--learner", "series"], "series has 136 MB of numbers, too many for a page"),
        (["--out", out, "--learner", "none"], "no learner is called none: choose from linear, ann"),
        (["--out", out, "--cortex"], "--cortex is for ONNX"),
        (["--out", str(tmp_path / "page.onnx"), "--to", "html"], "give a name with this extension"),
        (["--out", str(tmp_path / "model.onnx")], "no model is given"),
    ):
        assert main(["export", *given]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    posed = replace(theatre.models["ann"], tool=find_scene("press").tool.shape)
    with pytest.raises(InputError, match="ann is a model of poses"):
        choose_model(replace(theatre, models={"ann": posed}))
    with pytest.raises(InputError, match="there is no model"):
        choose_model(replace(theatre, models={}))
