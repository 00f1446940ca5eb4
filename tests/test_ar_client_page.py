"""HTML document of the page: title, icon and a script for browsers without WebGL."""

import gzip
import http.client
import json
import shutil
import subprocess
from contextlib import closing

import pytest
from test_ar_access_guard import Page

from ar.page.client_page import NO_WEBGL_CLASS, SCRIPT, SOFTWARE_PERIOD, build_document
from ar.page.style import build_style


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_page_document_contains_title_icon_and_script(encoding):
    with closing(Page()) as page, closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)) as wire:
        wire.request("GET", "/", headers={"Accept-Encoding": encoding})
        answer = wire.getresponse()
        body = answer.read()
    assert int(answer.headers["Content-Length"]) == len(body)
    text = (gzip.decompress(body) if encoding == "gzip" else body).decode()
    head = text[: text.index("</head>")]
    assert head.count("<title>") == 1 and "<title>sulcus</title>" in head and "Viser</title>" not in text
    assert head.count('rel="icon"') == 1 and "37e36b" in head
    assert head.index(SCRIPT[:60]) < head.index("<title>")  # before any of viser's own


def test_unknown_html_document_is_unchanged():
    assert build_document(b"<p>none</p>", False) == b"<p>none</p>"
    assert f":root.{NO_WEBGL_CLASS} canvas" in build_style(1.3)


# A canvas whose context counts drawings; four tasks of two drawings each, and one into a texture.
COUNTING = """
const drawn = [];
let time = 0, texture = null;
globalThis.performance = {now: () => time};
class HTMLCanvasElement { getContext() { return this.gl ??= new Context(); } }
class Context {
  RENDERER = 1; FRAMEBUFFER_BINDING = 2;
  getExtension() { return null; }
  getParameter(name) { return name === 1 ? NAME : texture; }
}
for (const name of ['clear', 'drawArrays', 'drawElements', 'drawArraysInstanced', 'drawElementsInstanced'])
  Context.prototype[name] = function () { drawn.push(`${name} ${time}`); };
eval(SCRIPT);
const canvas = new HTMLCanvasElement();
canvas.getContext('webgl2');
const gl = canvas.getContext('webgl2');
for (time of [0, 60, 120, 180]) {
  gl.clear(); gl.drawElements();
  await Promise.resolve();
}
texture = {};
gl.clear();
console.log(JSON.stringify(drawn));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
@pytest.mark.parametrize("name", ["ANGLE (Google, Vulkan 1.3 (SwiftShader Device))", "NVIDIA H200"])
def test_software_rendered_view_is_drawn_at_reduced_rate(name):
    code = COUNTING.replace("NAME", json.dumps(name)).replace(
        "eval(SCRIPT)", SCRIPT.replace("PERIOD", str(SOFTWARE_PERIOD))
    )
    run = ["node", "--input-type=module", "--eval", code]
    drawn = json.loads(subprocess.run(run, capture_output=True, text=True, check=True, timeout=60).stdout)
    times = [0, 180] if "SwiftShader" in name else [0, 60, 120, 180]
    # A task draws all or nothing, and textures are always drawn.
    assert drawn == [f"{call} {time}" for time in times for call in ("clear", "drawElements")] + ["clear 180"]
