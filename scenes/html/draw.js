"use strict";
// Drawing by WebGL: lit surfaces under a lamp, lines in pixels; the same light as ar/rendering/shade.py.

const SURFACE_VERTEX = `
  attribute vec3 place, facing; attribute vec2 texel;
  uniform mat4 view; uniform vec3 shift;
  varying vec3 at, normal; varying vec2 where;
  void main() {
    at = place + shift; normal = facing; where = texel;
    gl_Position = view * vec4(at, 1.0);
  }`;

const LIT_FRAGMENT = `
  precision highp float;
  varying vec3 at, normal; varying vec2 where;
  uniform vec3 eye, lamp, lampAxis, base, dark, right, up; uniform vec2 cone, light, shine; uniform float relief, step;
  uniform bool textured, shaded; uniform sampler2D scan; uniform vec3 ends[6]; uniform float radii[3];
  float lit(vec3 ray) { // share of the lamp that passes the tool, with a soft edge
    float share = 1.0;
    for (int k = 0; k < 3; k++) {
      vec3 rod = ends[2 * k + 1] - ends[2 * k], arm = ends[2 * k] - at;
      float slope = dot(ray, rod), room = max(dot(rod, rod) - slope * slope, 1e-12);
      vec3 axis = arm + clamp((slope * dot(ray, arm) - dot(rod, arm)) / room, 0.0, 1.0) * rod;
      float far = dot(axis, ray);
      float gap = length(axis - max(far, 0.0) * ray);
      share = min(share, smoothstep(0.8 * radii[k], 1.2 * radii[k], gap));
    }
    return share;
  }
  void main() {
    vec3 n = normalize(normal), sight = normalize(eye - at), ray = normalize(lamp - at), colour = base;
    if (dot(n, sight) < 0.0) n = -n;
    if (textured) {
      float value = texture2D(scan, where).r;
      vec2 slope = vec2(texture2D(scan, where + vec2(step, 0.0)).r - texture2D(scan, where - vec2(step, 0.0)).r,
                        texture2D(scan, where + vec2(0.0, step)).r - texture2D(scan, where - vec2(0.0, step)).r);
      colour *= dark + (1.0 - dark) * value;
      vec3 tilt = relief * (slope.x * right + slope.y * up);
      n = normalize(n - tilt + dot(tilt, n) * n);
    }
    float rim = clamp((-dot(ray, lampAxis) - cone.x) * cone.y, 0.0, 1.0);
    float arriving = light.x * rim * rim * (3.0 - 2.0 * rim);
    if (shaded && arriving > 0.0) arriving *= lit(ray);
    float ambient = light.y * (0.35 + 0.65 * max(0.0, dot(n, sight)));
    vec3 shown = colour * (ambient + arriving * max(0.0, (dot(n, ray) + 0.2) / 1.2));
    vec3 middle = normalize(ray + sight);
    float fresnel = 0.04 + 0.96 * pow(1.0 - max(0.0, dot(sight, middle)), 5.0);
    shown += arriving * shine.x * fresnel * exp(shine.y * (dot(n, middle) - 1.0)) * (shine.y + 8.0) * 0.12;
    vec3 film = clamp(shown * (2.51 * shown + 0.03) / (shown * (2.43 * shown + 0.59) + 0.14), 0.0, 1.0);
    gl_FragColor = vec4(sqrt(film), 1.0);
  }`;

const GLOW_FRAGMENT = `
  precision highp float;
  varying vec3 at, normal;
  uniform vec3 eye, base; uniform float opacity;
  void main() {
    float towards = abs(dot(normalize(normal), normalize(eye - at)));
    gl_FragColor = vec4(base * (0.35 + 0.75 * towards), opacity);
  }`;

const LINE_VERTEX = `
  attribute vec4 corner; // x, y, side, length along the line [pixel]
  uniform vec2 size;
  varying vec2 along;
  void main() {
    along = corner.zw;
    gl_Position = vec4(2.0 * corner.x / size.x - 1.0, 1.0 - 2.0 * corner.y / size.y, 0.0, 1.0);
  }`;

const LINE_FRAGMENT = `
  precision highp float;
  varying vec2 along;
  uniform vec4 ink; uniform float width, border; uniform vec2 strokes;
  void main() {
    if (strokes.y > 0.0 && mod(along.y, strokes.x + strokes.y) > strokes.x) discard;
    float far = abs(along.x);
    float cover = clamp(width + border + 0.5 - far, 0.0, 1.0), core = clamp(width + 0.5 - far, 0.0, 1.0);
    gl_FragColor = vec4(mix(vec3(0.04, 0.05, 0.05), ink.rgb, border > 0.0 ? core : 1.0), ink.a * cover);
  }`;

function buildProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  const list = (count, info, find) => Object.fromEntries(
    Array.from({ length: gl.getProgramParameter(program, count) }, (_, k) => info.call(gl, program, k).name)
      .map((name) => [name.replace("[0]", ""), find.call(gl, program, name)]));
  return {
    program,
    uniforms: list(gl.ACTIVE_UNIFORMS, gl.getActiveUniform, gl.getUniformLocation),
    attributes: list(gl.ACTIVE_ATTRIBUTES, gl.getActiveAttrib, gl.getAttribLocation),
  };
}

// Unit normals of vertices (x, y, z, ...), weighted by the areas of their triangles.
function normalsOf(points, triangles) {
  const out = new Float32Array(points.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => pointAt(points, triangles[t + k]));
    const normal = cross(minus(b, a), minus(c, a));
    for (let k = 0; k < 3; k++) for (let axis = 0; axis < 3; axis++) out[3 * triangles[t + k] + axis] += normal[axis];
  }
  for (let n = 0; n < out.length; n += 3) {
    const length = Math.hypot(out[n], out[n + 1], out[n + 2]) || 1;
    for (let axis = 0; axis < 3; axis++) out[n + axis] /= length;
  }
  return out;
}

function buildPainter(canvas, scene, arrays) {
  const gl = canvas.getContext("webgl", { alpha: false, antialias: true });
  if (!gl) return null;
  const programs = {
    lit: buildProgram(gl, SURFACE_VERTEX, LIT_FRAGMENT),
    glow: buildProgram(gl, SURFACE_VERTEX, GLOW_FRAGMENT),
    line: buildProgram(gl, LINE_VERTEX, LINE_FRAGMENT),
  };
  const lines = gl.createBuffer();

  function buffer(data, target = gl.ARRAY_BUFFER) {
    const made = gl.createBuffer();
    gl.bindBuffer(target, made);
    gl.bufferData(target, data, gl.DYNAMIC_DRAW);
    return made;
  }

  function addSurface(points, triangles, texels = new Float32Array((points.length / 3) * 2)) {
    return {
      triangles, count: triangles.length, place: buffer(points), facing: buffer(normalsOf(points, triangles)),
      texel: buffer(texels), index: buffer(triangles, gl.ELEMENT_ARRAY_BUFFER),
    };
  }

  function move(surface, points) {
    for (const [name, data] of [["place", points], ["facing", normalsOf(points, surface.triangles)]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, surface[name]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    }
  }

  function set(uniforms, values) {
    for (const [name, value] of Object.entries(values)) {
      const at = uniforms[name];
      if (at === undefined) continue;
      if (typeof value === "boolean") gl.uniform1i(at, +value);
      else if (typeof value === "number") gl.uniform1f(at, value);
      else if (name === "view") gl.uniformMatrix4fv(at, false, value);
      else if (name === "radii") gl.uniform1fv(at, value);
      else gl[`uniform${name === "ends" ? 3 : value.length}fv`](at, value);
    }
  }

  function drawSurface(name, surface, values) {
    const { program, uniforms, attributes } = programs[name];
    gl.useProgram(program);
    set(uniforms, values);
    for (const [attribute, length] of [["place", 3], ["facing", 3], ["texel", 2]]) {
      if (!(attribute in attributes)) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, surface[attribute]);
      gl.enableVertexAttribArray(attributes[attribute]);
      gl.vertexAttribPointer(attributes[attribute], length, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, surface.index);
    gl.drawElements(gl.TRIANGLES, surface.count, gl.UNSIGNED_SHORT, 0);
  }

  // Draw a closed line [[x, y], ...] in pixels, `half` on each side and a dark border; strokes: [stroke, gap] lengths.
  function drawLine(loop, ink, half, border = 0, strokes = [1, 0]) {
    const corners = new Float32Array(8 * (loop.length + 1)), reach = half + border + 1;
    let length = 0;
    for (let k = 0; k <= loop.length; k++) {
      const [before, at, after] = [k - 1, k, k + 1].map((n) => loop[(n + loop.length) % loop.length]);
      const size = Math.hypot(after[0] - before[0], after[1] - before[1]) || 1;
      const x = (after[1] - before[1]) / size, y = (before[0] - after[0]) / size;
      if (k) length += Math.hypot(at[0] - before[0], at[1] - before[1]);
      corners.set([at[0] + reach * x, at[1] + reach * y, reach, length], 8 * k);
      corners.set([at[0] - reach * x, at[1] - reach * y, -reach, length], 8 * k + 4);
    }
    const { program, uniforms, attributes } = programs.line;
    gl.useProgram(program);
    set(uniforms, { size: [canvas.width, canvas.height], ink, width: half, border, strokes });
    gl.bindBuffer(gl.ARRAY_BUFFER, lines);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(attributes.corner);
    gl.vertexAttribPointer(attributes.corner, 4, gl.FLOAT, false, 0, 0);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 2 * (loop.length + 1));
  }

  function addTexture(values, side) {
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.LUMINANCE, side, side, 0, gl.LUMINANCE, gl.UNSIGNED_BYTE, values);
    for (const edge of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, edge, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  }

  const cortex = addSurface(arrays.cortex, arrays.cortexTriangles, arrays.texels);
  const drape = addSurface(arrays.drape, arrays.drapeTriangles);
  const tool = addSurface(arrays.tool, arrays.toolTriangles);
  const tumour = addSurface(arrays.tumour, arrays.tumourTriangles);
  if (arrays.scan) addTexture(arrays.scan, Math.sqrt(arrays.scan.length));

  // Draw one image. `picture`: view matrix, positions, tip and axis ends of the tool, and the lines with their inks.
  return function paint({ view, positions, tumourPositions, tip, ends, glow, lines: drawn }) {
    move(cortex, positions);
    move(tumour, tumourPositions);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...scene.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const all = { ...scene.light, view, ends, radii: scene.tool.radii, shift: [0, 0, 0], textured: false, shaded: true };
    drawSurface("lit", cortex, { ...all, ...scene.looks.cortex, textured: !!arrays.scan });
    drawSurface("lit", drape, { ...all, ...scene.looks.drape });
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.CULL_FACE);
    drawSurface("glow", tumour, { view, eye: scene.light.eye, shift: [0, 0, 0], base: glow, opacity: 0.45 });
    gl.disable(gl.CULL_FACE);
    for (const line of drawn) drawLine(...line);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    drawSurface("lit", tool, { ...all, ...scene.looks.tool, shift: tip, shaded: false });
  };
}
