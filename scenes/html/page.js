"use strict";
// The page: decodes the arrays, holds the state (place and force of the tool), solves and draws when it changes.

const MAX_INTERVAL = 34; // time between two images above which fewer pixels are drawn [ms]
const PAUSE = 1000; // time between two images that counts as a pause [ms]
const REST = 200; // time without a change after which the image is drawn with all pixels [ms]
const MIN_QUALITY = 0.5; // smallest share of the window's pixels along each axis
const KEY_STEP = 1e-3, FORCE_STEP = 0.02; // of one key press [m], [N]
const TYPES = { f4: Float32Array, f8: Float64Array, i4: Int32Array, u2: Uint16Array, u1: Uint8Array };
const byId = (id) => document.getElementById(id);

// Arrays by name: base64 of deflated bytes, in which the first bytes of an array's numbers come first, then the second.
async function decode(text, table) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer()), arrays = {};
  let start = 0;
  for (const [name, [type, shape]] of Object.entries(table)) {
    const count = countOf(shape), width = TYPES[type].BYTES_PER_ELEMENT, plain = new Uint8Array(count * width);
    for (let k = 0; k < width; k++) {
      for (let n = 0; n < count; n++) plain[n * width + k] = bytes[start + k * count + n];
    }
    arrays[name] = { shape, data: new TYPES[type](plain.buffer) };
    start += count * width;
  }
  return arrays;
}

async function open() {
  const scene = JSON.parse(byId("scene").textContent);
  const found = await decode(byId("arrays").textContent, scene.arrays);
  const arrays = {}, constants = {};
  for (const [name, { shape, data }] of Object.entries(found)) {
    if (name.startsWith("constant_")) constants[name] = { shape, data: Float64Array.from(data) };
    else arrays[name] = data;
  }
  return start(scene, arrays, buildGraph(scene.graph, constants));
}

function start(scene, arrays, graph) {
  const { frame, tool, words } = scene, canvas = byId("view"), slider = byId("force");
  const surface = { points: arrays.patch, triangles: arrays.patchTriangles };
  const paint = buildPainter(canvas, scene, arrays);
  const state = { x: 0, y: 0, force: scene.force.start, quality: 1, dirty: true, result: null, images: 0 };
  if (!paint) byId("result").textContent = "This browser has no WebGL: the image cannot be drawn.";

  // Outputs of the model for one load: point [m], force [N], footprint radius [m].
  function solve(point, force, footprint) {
    const weight = () => ({ shape: [1, surface.points.length / 3], data: footprintWeights(surface, point, footprint) });
    const inputs = {
      point: { shape: [1, 3], data: Float64Array.from(point) }, force: { shape: [1, 3], data: Float64Array.from(force) },
      footprint: { shape: [1], data: Float64Array.of(footprint) },
    };
    return graph(scene.graph.inputs.includes("weight") ? { ...inputs, weight: weight() } : inputs);
  }

  // Contact point of the tool at a place (x, y) of the tangent plane, which the bone limits.
  const contactAt = (x, y) => nearestOnSurface(surface, along(along(frame.origin, frame.right, x), frame.up, y));

  function moveTo(x, y) {
    const share = Math.min(1, frame.reach / Math.max(Math.hypot(x, y), 1e-12));
    Object.assign(state, { x: share * x, y: share * y, dirty: true });
  }

  function press(force) {
    state.force = Math.min(Math.max(force, 0), scene.force.most);
    state.dirty = true;
    slider.value = state.force;
    byId("newtons").textContent = `${state.force.toFixed(2)} N`;
  }

  // Position of vertices: undeformed, plus the displacement of the model's row of each, if it has one.
  function displace(rest, rows, displacement) {
    const out = Float32Array.from(rest);
    rows.forEach((row, n) => {
      if (row !== 0xffff) for (let axis = 0; axis < 3; axis++) out[3 * n + axis] += displacement[3 * row + axis];
    });
    return out;
  }

  function compute() {
    const contact = contactAt(state.x, state.y), force = frame.axis.map((one) => state.force * one);
    const answer = solve(contact.point, force, tool.radius), displacement = answer.displacement.data;
    const patch = displace(arrays.patch, arrays.patchRows, displacement);
    const carried = contact.vertices.map((n, k) => pointAt(patch, n).map((value) => contact.weights[k] * value))
      .reduce((sum, one) => along(sum, one, 1));
    const lift = scene.force.lift * Math.max(0, 1 - state.force / scene.force.visible);
    const touched = restingTip({ ...surface, points: patch }, carried, frame.axis, tool.radius);
    const tumour = displace(arrays.tumour, arrays.tumourRows, displacement);
    let moved = 0;
    for (let n = 0; n < arrays.tumourRows.length; n++) {
      moved += sizeOf(pointAt(displacement, arrays.tumourRows[n])) / arrays.tumourRows.length;
    }
    const outside = answer.extrapolated.data[0] > 0, bound = answer.bound.data[0];
    state.result = {
      contact, displacement, tumour, moved, outside, bound: outside || !(bound < Infinity) ? null : bound,
      cortex: displace(arrays.cortex, arrays.cortexRows, displacement), tip: along(touched, frame.axis, -lift),
    };
  }

  function resize(quality) {
    const ratio = (window.devicePixelRatio || 1) * quality;
    const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  }

  // Mapping from the camera's image to the canvas: the image is as large as fits, in the middle.
  function fit() {
    const { width, height } = scene.camera, scale = Math.min(canvas.width / width, canvas.height / height);
    const ratio = canvas.width / canvas.clientWidth;
    return { ratio, scale, left: 0.5 * (canvas.width - scale * width), top: 0.5 * (canvas.height - scale * height) };
  }

  function toCamera(point) {
    const T = scene.camera.T;
    return [0, 1, 2].map((row) => dot(T[row], point) + T[row][3]);
  }

  // Place on the canvas [pixel] of a point [m]; pixel centres of the image are whole numbers.
  function project(point, { scale, left, top }) {
    const [x, y, z] = toCamera(point), { focal, centre } = scene.camera;
    return [left + scale * (focal * x / z + centre[0] + 0.5), top + scale * (focal * y / z + centre[1] + 0.5)];
  }

  // The same as a matrix of WebGL, column by column.
  function viewMatrix({ scale, left, top }) {
    const { focal, centre, T, near, far } = scene.camera, [w, h] = [canvas.width, canvas.height];
    const x = T[0].map((value, k) => (2 / w) * scale * focal * value + ((2 / w) * (left + scale * (centre[0] + 0.5)) - 1) * T[2][k]);
    const y = T[1].map((value, k) => (-2 / h) * scale * focal * value + (1 - (2 / h) * (top + scale * (centre[1] + 0.5))) * T[2][k]);
    const z = T[2].map((value, k) => ((far + near) * value - (k === 3 ? 2 * far * near : 0)) / (far - near));
    return Float32Array.from({ length: 16 }, (_, k) => [x, y, z, T[2]][k % 4][k >> 2]);
  }

  function outline(points, view, margin = 0) {
    const normals = margin ? normalsOf(points, arrays.tumourTriangles) : null, flat = [];
    for (let n = 0; n < points.length / 3; n++) {
      const at = pointAt(points, n);
      flat.push(...project(margin ? along(at, pointAt(normals, n), margin) : at, view));
    }
    return outlineOf(flat, arrays.tumourTriangles);
  }

  let still = {}; // outline in the scan, until the view changes
  function outlineInScan(view) {
    const key = JSON.stringify(view);
    if (still.key !== key) still = { key, edge: outline(arrays.tumour, view) };
    return still.edge;
  }

  // Error of the tumour position in the patient [m], in proportion to the motion; null: not known.
  function positionError({ moved, bound }) {
    const error = scene.positionError;
    return error && bound !== null ? Math.hypot(error.rest, error.surface * moved, bound) : null;
  }

  function draw(quality) {
    resize(quality);
    const view = fit(), { result } = state, now = result.outside ? scene.inks.doubtful : scene.inks.tumour;
    const edge = outline(result.tumour, view), error = positionError(result), lines = [], r = view.ratio;
    const perMetre = view.scale * scene.camera.focal / toCamera(pointAt(result.tumour, 0))[2];
    if (error !== null) {
      lines.push([outline(result.tumour, view, error), [...now.map((one) => 0.75 * one), 0.9], 0.6 * r, 0, [12 * r, 7 * r]]);
    }
    if (result.bound !== null && state.force > 0) lines.push([edge, [...now, 0.3], result.bound * perMetre]);
    lines.push([edge, [...now, 1], 1.4 * r, r, result.outside ? [9 * r, 6 * r] : [1, 0]]);
    lines.push([outlineInScan(view), [...scene.inks.scan, 1], 0.9 * r, 0.7 * r, [2.5 * r, 5 * r]]);
    const ball = along(result.tip, frame.axis, -tool.radius);
    paint?.({
      view: viewMatrix(view), positions: result.cortex, tumourPositions: result.tumour, tip: result.tip, ball, glow: now,
      lines,
    });
    Object.assign(state, { edge, view, error });
    describe(result, error);
  }

  const upTo = (metres, digits) => {
    const unit = 10 ** digits;
    return `${(Math.max(Math.ceil(+(1e3 * metres * unit).toFixed(6)), 1) / unit).toFixed(digits)} mm`;
  };

  function describe(result, error) {
    const moved = `tumour moved ${(1e3 * result.moved).toFixed(2)} mm`, known = result.bound !== null;
    byId("result").textContent = state.force === 0 ? words.still
      : known ? `${moved} (model error ≤ ${upTo(result.bound, 2)})` : `${moved} (error not known)`;
    byId("doubt").textContent = result.outside ? words.outside : "";
    byId("position").textContent = error === null ? words.unknown : `${words.position} ≤ ${upTo(error, 1)} (95 %)${words.guess}`;
    document.body.classList.toggle("doubtful", result.outside);
  }

  let last = 0, slow = 0;
  function loop(time) {
    if (state.dirty) {
      const late = time - last > MAX_INTERVAL && time - last < PAUSE;
      slow = late ? slow + 1 : Math.max(0, slow - 1);
      if (slow > 4 && state.quality > MIN_QUALITY) [state.quality, slow] = [Math.max(MIN_QUALITY, 0.75 * state.quality), 0];
      last = time;
      state.dirty = false;
      compute();
      draw(state.quality);
      state.images += 1;
      state.sharp = state.quality === 1;
    } else if (!state.sharp && time - last > REST) { // all pixels once nothing moves
      draw(1);
      state.sharp = true;
    }
    requestAnimationFrame(loop);
  }

  // Place (x, y) in the tangent plane under a pixel of the canvas, at the height of the contact.
  function pick(column, row) {
    const { scale, left, top } = fit(), { focal, centre, T } = scene.camera;
    const seen = [(column - left) / scale - 0.5 - centre[0], (row - top) / scale - 0.5 - centre[1], focal];
    const ray = [0, 1, 2].map((axis) => T[0][axis] * seen[0] + T[1][axis] * seen[1] + T[2][axis] * seen[2]);
    let depth = 0, x = 0, y = 0;
    for (let k = 0; k < 4; k++) {
      const from = minus(scene.light.eye, along(frame.origin, frame.axis, depth));
      const at = along(from, ray, -dot(from, frame.axis) / dot(ray, frame.axis));
      [x, y] = [dot(at, frame.right), dot(at, frame.up)];
      const share = Math.min(1, frame.reach / Math.max(Math.hypot(x, y), 1e-12));
      depth = dot(minus(contactAt(share * x, share * y).point, frame.origin), frame.axis);
    }
    return [x, y];
  }

  let grasp = null; // offset between the pointer and the tool's contact while it is dragged
  const pixelOf = (event) => {
    const box = canvas.getBoundingClientRect(), { ratio } = fit();
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  };
  canvas.addEventListener("pointerdown", (event) => {
    const at = pixelOf(event), view = fit(), contact = project(state.result.contact.point, view);
    const ball = project(along(state.result.tip, frame.axis, -tool.radius), view);
    const reach = 1.3 * tool.radius * view.scale * scene.camera.focal / toCamera(state.result.tip)[2];
    const grasped = Math.hypot(at[0] - ball[0], at[1] - ball[1]) < reach;
    grasp = grasped ? [contact[0] - at[0], contact[1] - at[1]] : [0, 0];
    canvas.setPointerCapture(event.pointerId);
    moveTo(...pick(at[0] + grasp[0], at[1] + grasp[1]));
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!grasp) return;
    const at = pixelOf(event);
    moveTo(...pick(at[0] + grasp[0], at[1] + grasp[1]));
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (grasp = null));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    press(state.force - Math.sign(event.deltaY) * FORCE_STEP);
  }, { passive: false });
  slider.addEventListener("input", () => press(+slider.value));
  window.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const change = { "+": 1, "=": 1, "-": -1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || (!step && !change) || (step && event.target === slider)) return;
    event.preventDefault();
    if (step) moveTo(state.x + KEY_STEP * step[0], state.y + KEY_STEP * step[1]);
    else press(state.force + FORCE_STEP * change);
  });
  new ResizeObserver(() => (state.dirty = true)).observe(canvas);
  press(state.force);
  requestAnimationFrame(loop);
  return { scene, state, solve, moveTo, press, project, fit, draw };
}

// For other scripts and tests: a promise of the page's state and functions.
window.sulcus = open().catch((error) => {
  byId("result").textContent = `The page cannot be opened in this browser: ${error.message}`;
  throw error;
});
