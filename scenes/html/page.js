"use strict";
// The page: holds the state (place and force of the tool), solves and draws when it changes.

const MAX_INTERVAL = 34; // time between two images above which fewer pixels are drawn [ms]
const PAUSE = 1000; // time between two images that counts as a pause [ms]
const REST = 200; // time without a change after which the image is drawn with all pixels [ms]
const MIN_QUALITY = 0.4; // smallest share of the window's pixels along each axis
const KEY_STEP = 1e-3, FORCE_STEP = 0.02; // of one key press [m], [N]
const byId = (id) => document.getElementById(id);

async function open() {
  const scene = JSON.parse(byId("scene").textContent);
  return start(scene, await openModel(scene, byId("arrays").textContent));
}

function start(scene, { arrays, surface, solve }) {
  const { frame, tool, words } = scene, canvas = byId("view"), slider = byId("force");
  const paint = buildPainter(canvas, scene, arrays);
  const state = { x: 0, y: 0, force: scene.force.start, quality: 1, dirty: true, result: null, images: 0 };

  // Contact point of the tool at a place (x, y) of the tangent plane, which the bone limits.
  const contactAt = (x, y) => nearestOnSurface(surface, along(along(frame.origin, frame.right, x), frame.up, y));

  function inReach(x, y) {
    const share = Math.min(1, frame.reach / Math.max(Math.hypot(x, y), 1e-12));
    return [share * x, share * y];
  }

  function moveTo(...place) {
    [state.x, state.y] = inReach(...place);
    state.dirty = true;
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

  // Place of the tool on the deformed cortex as in scenes/play/player.py: lifted off if idle, and stopped by the bone.
  function placeTool(contact, displacement) {
    const patch = displace(arrays.patch, arrays.patchRows, displacement), { lift, visible, carried } = scene.force;
    const moved = contact.vertices.map((n) => minus(pointAt(patch, n), frame.origin));
    const at = moved.reduce((sum, one, k) => along(sum, one, contact.weights[k]), [0, 0, 0]);
    const flat = [dot(at, frame.right), dot(at, frame.up)], stopped = inReach(...flat);
    const beyond = Math.hypot(flat[0] - stopped[0], flat[1] - stopped[1]);
    const [x, y] = beyond > carried ? [stopped[0] - flat[0], stopped[1] - flat[1]] : [0, 0];
    const through = along(along(along(frame.origin, at, 1), frame.right, x), frame.up, y);
    const tip = restingTip({ ...surface, points: patch }, through, frame.axis, tool.radius);
    return { tip: along(tip, frame.axis, -lift * Math.max(0, 1 - state.force / visible)), beyond };
  }

  function compute() {
    const contact = contactAt(state.x, state.y), force = frame.axis.map((one) => state.force * one);
    const answer = solve(contact.point, force, tool.radius), displacement = answer.displacement.data;
    const { tip, beyond } = placeTool(contact, displacement), rows = [...arrays.tumourRows];
    const blocked = beyond > scene.force.blocked ? words.blocked : "", ofLoad = answer.bound.data[0];
    const doubt = answer.extrapolated.data[0] ? words.outside : blocked, known = scene.positionError;
    const bound = doubt ? null : Number.isFinite(ofLoad) ? ofLoad : scene.bound; // error of the model [m]
    const moved = rows.reduce((sum, row) => sum + sizeOf(pointAt(displacement, row)), 0) / rows.length;
    // Error of the tumour position in the patient [m], in proportion to the motion; null: not known.
    const error = known && bound !== null ? Math.hypot(known.rest, known.surface * moved, bound) : null;
    const tumour = displace(arrays.tumour, rows, displacement);
    const cortex = displace(arrays.cortex, arrays.cortexRows, displacement);
    state.result = { contact, displacement, tip, doubt, bound, moved, error, tumour, cortex };
  }

  // Mapping to the canvas: the camera's image is as large as fits, in the middle. Focal length and centre in pixels, of
  // which whole numbers are at the corners; `ratio`: pixels of the canvas per pixel of the window.
  function fit() {
    const { width, height, focal, centre } = scene.camera, ratio = canvas.width / canvas.clientWidth;
    const scale = Math.min(canvas.width / width, canvas.height / height);
    const at = [0.5 * (canvas.width - scale * width), 0.5 * (canvas.height - scale * height)];
    return { ratio, focal: scale * focal, centre: at.map((start, k) => start + scale * (centre[k] + 0.5)) };
  }

  const toCamera = (point) => scene.camera.T.map((row) => dot(row, point) + row[3]);

  function project(point, { focal, centre }) {
    const [x, y, z] = toCamera(point);
    return [centre[0] + (focal * x) / z, centre[1] + (focal * y) / z];
  }

  // The same as a matrix of WebGL, column by column.
  function viewMatrix({ focal, centre }) {
    const { T, near, far } = scene.camera, x = 2 / canvas.width, y = 2 / canvas.height;
    const row = (axis, factor, shift) => T[axis].map((value, k) => factor * value + shift * T[2][k]);
    const depth = T[2].map((value, k) => ((far + near) * value - (k === 3 ? 2 * far * near : 0)) / (far - near));
    const rows = [row(0, x * focal, x * centre[0] - 1), row(1, -y * focal, 1 - y * centre[1]), depth, T[2]];
    return Float32Array.from({ length: 16 }, (_, k) => rows[k % 4][k >> 2]);
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

  function draw(quality) {
    const pixels = (window.devicePixelRatio || 1) * quality;
    const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * pixels)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const view = fit(), r = view.ratio, { result } = state, lines = [];
    const now = result.doubt ? scene.inks.doubtful : scene.inks.tumour;
    const edge = outline(result.tumour, view), pale = [...now.map((one) => 0.75 * one), 0.9];
    if (result.error) lines.push([outline(result.tumour, view, result.error), pale, 0.6 * r, 0, [12 * r, 7 * r]]);
    const band = ((result.bound ?? 0) * view.focal) / toCamera(pointAt(result.tumour, 0))[2];
    if (band) lines.push([edge, [...now, 0.3], band]);
    lines.push([edge, [...now, 1], 1.4 * r, r, result.doubt ? [9 * r, 6 * r] : [1, 0]]);
    lines.push([outlineInScan(view), [...scene.inks.scan, 1], 0.9 * r, 0.7 * r, [2.5 * r, 5 * r]]);
    const ball = along(result.tip, frame.axis, -tool.radius);
    paint({ ...result, view: viewMatrix(view), ball, ink: now, lines });
    Object.assign(state, { edge, view });
    describe(result);
  }

  // Bound in millimetres, rounded up.
  function upTo(metres, digits) {
    const unit = 10 ** digits, whole = Math.max(Math.ceil(+(1e3 * metres * unit).toFixed(6)), 1);
    return `\u2264 ${(whole / unit).toFixed(digits)} mm`;
  }

  function describe({ moved, bound, error, doubt }) {
    const within = bound === null ? "error not known" : `model error ${upTo(bound, 2)}`;
    byId("result").textContent = state.force ? `tumour moved ${(1e3 * moved).toFixed(2)} mm (${within})` : words.still;
    byId("doubt").textContent = doubt;
    const known = error !== null && `${words.position} ${upTo(error, 1)} ${words.guess}`;
    byId("position").textContent = known || words.unknown;
    document.body.classList.toggle("doubtful", !!doubt);
  }

  let last = 0, slow = 0;
  function loop(time) {
    if (state.dirty) {
      const late = time - last > MAX_INTERVAL && time - last < PAUSE;
      slow = late ? slow + 1 : Math.max(0, slow - 0.3);
      if (slow > 4) [state.quality, slow] = [Math.max(MIN_QUALITY, 0.75 * state.quality), 0];
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
  function pick([column, row]) {
    const { focal, centre } = fit(), T = scene.camera.T, seen = [column - centre[0], row - centre[1], focal];
    const ray = [0, 1, 2].map((axis) => dot(T.map((row) => row[axis]), seen));
    let depth = 0, place = [0, 0];
    for (let k = 0; k < 4; k++) {
      const from = minus(scene.light.eye, along(frame.origin, frame.axis, depth));
      const at = along(from, ray, -dot(from, frame.axis) / dot(ray, frame.axis));
      place = [dot(at, frame.right), dot(at, frame.up)];
      depth = dot(minus(contactAt(...inReach(...place)).point, frame.origin), frame.axis);
    }
    return place;
  }

  let grasp = null; // offset from the pointer to the tool's contact while it is dragged [pixel of the window]
  function pointerAt(event, ratio) {
    const box = canvas.getBoundingClientRect(), [x, y] = grasp ?? [0, 0];
    return [ratio * (event.clientX - box.left + x), ratio * (event.clientY - box.top + y)];
  }
  const drag = (event) => grasp && moveTo(...pick(pointerAt(event, fit().ratio)));
  canvas.addEventListener("pointerdown", (event) => {
    grasp = null;
    const view = fit(), at = pointerAt(event, view.ratio), contact = project(state.result.contact.point, view);
    const ball = project(along(state.result.tip, frame.axis, -tool.radius), view);
    const reach = (1.3 * tool.radius * view.focal) / toCamera(state.result.tip)[2];
    const grasped = Math.hypot(at[0] - ball[0], at[1] - ball[1]) < reach; // else the tool comes to the pointer
    grasp = [0, 1].map((axis) => (grasped ? (contact[axis] - at[axis]) / view.ratio : 0));
    canvas.setPointerCapture(event.pointerId);
    drag(event);
  });
  canvas.addEventListener("pointermove", drag);
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (grasp = null));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    press(state.force - Math.sign(event.deltaY) * FORCE_STEP);
  }, { passive: false });
  slider.addEventListener("input", () => press(+slider.value));
  window.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const change = { "+": 1, "=": 1, "-": -1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || (step && event.target === slider)) return;
    if (step) moveTo(state.x + KEY_STEP * step[0], state.y + KEY_STEP * step[1]);
    if (change) press(state.force + FORCE_STEP * change);
    if (step || change) event.preventDefault();
  });
  new ResizeObserver(() => (state.dirty = true)).observe(canvas);
  press(state.force);
  requestAnimationFrame(loop);
  return { scene, state, solve, moveTo, press, project, fit };
}

// For other scripts and tests: a promise of the page's state and functions.
window.sulcus = open().catch((error) => {
  byId("result").textContent = `The page cannot be opened in this browser: ${error.message}`;
  throw error;
});
