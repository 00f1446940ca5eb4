"use strict";
// Drawing by WebGL: lit surfaces under a lamp, and lines in pixels.

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
      .map((name) => [name, find.call(gl, program, name)]));
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

// Place of a point's ray to the lamp relative to a rod: signed distance of their lines, and distance along the rod [m].
function shadowPlace(point, lamp, start, rod) {
  const towards = minus(lamp, point), size = sizeOf(towards), ray = towards.map((value) => value / size);
  const arm = minus(start, point), across = cross(ray, rod), slope = dot(ray, rod);
  return [dot(across, arm) / sizeOf(across), (slope * dot(ray, arm) - dot(rod, arm)) / (1 - slope * slope)];
}

// True if no graphics card draws: smooth edges would take too long.
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl"), info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl?.getParameter(info?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER) ?? "";
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function buildPainter(canvas, scene, arrays) {
  const gl = canvas.getContext("webgl", { alpha: false, antialias: !isSoftware() });
  if (!gl) throw new Error("it has no WebGL");
  const code = Object.fromEntries(byId("shaders").textContent.split("//@ ").map((part) => part.split(/\n([^]*)/)));
  const build = (name, mark) => buildProgram(
    gl, code.LIGHT + code[`${name}_VERTEX`], mark + code.LIGHT + code.SHADOW + code[`${name}_FRAGMENT`]);
  const mark = "#define SHADED\n"; // of programs that look for the tool's shadow
  const programs = {
    plain: build("PLAIN", ""), plainShaded: build("PLAIN", mark), lit: build("LIT", ""), litShaded: build("LIT", mark),
    glow: buildProgram(gl, code.LIGHT + code.LIT_VERTEX, code.GLOW_FRAGMENT),
    line: buildProgram(gl, code.LINE_VERTEX, code.LINE_FRAGMENT),
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
      points, triangles, place: buffer(points), facing: buffer(normalsOf(points, triangles)), texel: buffer(texels),
      index: buffer(triangles, gl.ELEMENT_ARRAY_BUFFER),
    };
  }

  function move(surface, points) {
    surface.points = points;
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
      else gl[`uniform${value.length}fv`](at, value);
    }
  }

  // Draw a surface: first the triangles that the tool's shadow cannot reach, then the others, which take longer.
  function drawShaded(name, surface, values) {
    const { ball, rod, lamp } = values, { points } = surface, parts = [[], []], reach = 1.3 * scene.tool.radius;
    const lines = Array.from({ length: points.length / 3 }, (_, n) => shadowPlace(pointAt(points, n), lamp, ball, rod));
    for (let t = 0; t < surface.triangles.length; t += 3) {
      const corners = surface.triangles.subarray(t, t + 3), [a, b, c] = [...corners].map((n) => lines[n]);
      const beyond = Math.max(a[1], b[1], c[1]) < -2 * reach; // the end of the tool
      const beside = Math.min(a[0], b[0], c[0]) > reach || Math.max(a[0], b[0], c[0]) < -reach;
      parts[beside || beyond ? 0 : 1].push(...corners);
    }
    drawSurface(name, surface, values, Uint16Array.from(parts[0]));
    drawSurface(`${name}Shaded`, surface, values, Uint16Array.from(parts[1]));
  }

  function drawSurface(name, surface, values, triangles = surface.triangles) {
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
    if (triangles !== surface.triangles) gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.DYNAMIC_DRAW);
    gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_SHORT, 0);
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

  const cortex = addSurface(arrays.cortex, arrays.cortexTriangles, arrays.texels);
  const [drape, tool, tumour] = ["drape", "tool", "tumour"].map(
    (name) => addSurface(arrays[name], arrays[`${name}Triangles`]));
  if (arrays.scan) {
    const side = Math.sqrt(arrays.scan.length / 3);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, side, side, 0, gl.RGB, gl.UNSIGNED_BYTE, arrays.scan);
    for (const edge of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, edge, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  }

  // Draw one image: the view matrix, vertices of cortex and tumour, tip and ball of the tool, ink of the tumour, lines.
  return function paint(image) {
    const { view, tip, ball } = image;
    move(cortex, image.cortex);
    move(tumour, image.tumour);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...scene.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const { rod, radii } = scene.tool;
    const all = { ...scene.light, view, ball, rod, radii, shift: [0, 0, 0], textured: false };
    drawShaded("lit", cortex, { ...all, ...scene.looks.cortex, textured: !!arrays.scan });
    drawShaded("plain", drape, { ...all, ...scene.looks.drape });
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.CULL_FACE);
    drawSurface("glow", tumour, { ...all, base: image.ink, opacity: 0.45 });
    gl.disable(gl.CULL_FACE);
    for (const line of image.lines) drawLine(...line);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    drawSurface("lit", tool, { ...all, ...scene.looks.tool, shift: tip });
  };
}
