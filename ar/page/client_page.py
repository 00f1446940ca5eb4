"""HTML document that a browser loads first: viser's, with this page's title and icon, and usable without WebGL.

Viser's client reads the server's messages only while it draws. In a browser without WebGL, a null renderer replaces it:
image, controls and tabs work, and only the 3-D view is missing. If WebGL is computed on the CPU, the 3-D view is drawn
only a few times per second, so that the camera image keeps its frame rate.
"""

import gzip
import re
from functools import lru_cache
from urllib.parse import quote

TITLE = "sulcus"  # Title of the page.
ICON = (  # Icon of the page (SVG).
    "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'><rect width='32' height='32' rx='7' fill='#141414'/>"
    "<circle cx='16' cy='16' r='9' fill='#1f6f3a' stroke='#37e36b' stroke-width='3'/>"
    "<path d='M4 10 Q16 3 28 10' fill='none' stroke='#eee' stroke-width='2' stroke-dasharray='2 2'/></svg>"
)
NO_WEBGL_CLASS = "sulcus-without-webgl"
"""Class of the document's root element in a browser without WebGL."""
SOFTWARE_PERIOD = 150  # Minimum period of drawing the 3-D view without a graphics card [ms].
# Each WebGL constant equals its own name here, so that results are looked up by name.
SCRIPT = """
(() => {
  const given = HTMLCanvasElement.prototype.getContext;
  const four = ['SCISSOR_BOX', 'VIEWPORT', 'COLOR_CLEAR_VALUE', 'BLEND_COLOR'];
  const texts = {VERSION: 'WebGL 2.0', SHADING_LANGUAGE_VERSION: 'WebGL GLSL ES 3.00'};
  const answers = {
    getParameter: name => texts[name] ?? (four.includes(name) ? [0, 0, 1, 1] : 16),
    getProgramParameter: (program, name) => String(name).startsWith('ACTIVE') ? 0 : true,
    getShaderParameter: () => true,
    getShaderPrecisionFormat: () => ({precision: 23, rangeMin: 127, rangeMax: 127}),
    getContextAttributes: () => ({alpha: true, depth: true, stencil: false, antialias: true}),
    getProgramInfoLog: () => '', getShaderInfoLog: () => '', getSupportedExtensions: () => [],
    getExtension: () => null, getUniformLocation: () => null, getAttribLocation: () => -1,
    isContextLost: () => false, getError: () => 0, checkFramebufferStatus: () => 'FRAMEBUFFER_COMPLETE',
    clientWaitSync: () => 'CONDITION_SATISFIED', getSyncParameter: () => 'SIGNALED',
  };
  const nothing = canvas => new Proxy({canvas, drawingBufferWidth: 1, drawingBufferHeight: 1}, {
    get(target, name) {
      if (name in target) return target[name];
      if (typeof name !== 'string') return undefined;
      if (/^[A-Z0-9_]+$/.test(name)) return name;
      return answers[name] ?? (name.startsWith('create') ? () => ({}) : () => undefined);
    },
  });
  // Drawings to the screen are skipped until the period is over; one task of the browser draws all or nothing.
  const slowDown = gl => {
    let last = -Infinity, drawn = null;
    const isDue = () => {
      if (drawn === null) {
        drawn = performance.now() - last >= PERIOD;
        if (drawn) last = performance.now();
        queueMicrotask(() => { drawn = null; });
      }
      return drawn;
    };
    for (const name of ['clear', 'drawArrays', 'drawElements', 'drawArraysInstanced', 'drawElementsInstanced']) {
      const draw = gl[name];
      gl[name] = function (...values) {
        if (gl.getParameter(gl.FRAMEBUFFER_BINDING) || isDue()) draw.apply(gl, values);
      };
    }
  };
  const isSoftware = gl => {
    const info = gl.getExtension('WEBGL_debug_renderer_info');
    const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    return /swiftshader|llvmpipe|softpipe|basic render/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    const found = given.call(this, kind, ...more);
    if (found && /webgl/.test(kind) && !found.sulcusSeen) {
      found.sulcusSeen = true;
      if (isSoftware(found)) slowDown(found);
    }
    if (found || !/webgl/.test(kind)) return found;
    document.documentElement.classList.add('WITHOUT');
    return this.sulcusNothing ??= nothing(this);
  };
})();
"""


@lru_cache(maxsize=4)
def build_document(document: bytes, is_zipped: bool) -> bytes:
    """Insert this page's title, icon and script into viser's document; return it, compressed if `is_zipped`."""
    text = (gzip.decompress(document) if is_zipped else document).decode()
    icon = f'<link rel="icon" href="data:image/svg+xml,{quote(ICON)}" />'
    script = f"<script>{SCRIPT.replace('WITHOUT', NO_WEBGL_CLASS).replace('PERIOD', str(SOFTWARE_PERIOD))}</script>"
    for pattern, own in (
        (r"<title>[^<]*</title>", f"<title>{TITLE}</title>"),
        (r'<link\s+rel="icon"[^>]*>', icon),
        (r"<head>", f"<head>{script}"),
    ):
        text = re.sub(pattern, lambda _, own=own: own, text, count=1)
    return gzip.compress(text.encode()) if is_zipped else text.encode()
