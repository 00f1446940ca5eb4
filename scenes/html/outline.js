"use strict";
// Smooth outline of a projected surface: the contour of its mask on a small canvas, resampled and smoothed.

const MASK_SIDE = 160; // longer side of the mask [pixel]
const OUTLINE_POINTS = 180;
const SMOOTHING = 12; // number of passes of the filter (1, 2, 1) / 4
const maskCanvas = document.createElement("canvas");
const maskContext = maskCanvas.getContext("2d", { willReadFrequently: true });

// Outline [[x, y], ...] of points (x, y, x, y, ...) connected by triangles, in the unit of the points.
function outlineOf(points, triangles) {
  const xs = points.filter((_, k) => k % 2 === 0), ys = points.filter((_, k) => k % 2 === 1);
  const left = Math.min(...xs), top = Math.min(...ys), span = Math.max(Math.max(...xs) - left, Math.max(...ys) - top);
  const scale = (MASK_SIDE - 8) / span, x = (n) => 4 + scale * (xs[n] - left), y = (n) => 4 + scale * (ys[n] - top);
  maskCanvas.width = maskCanvas.height = MASK_SIDE; // also clears it
  maskContext.beginPath();
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = triangles.subarray(t, t + 3);
    const turn = (x(b) - x(a)) * (y(c) - y(a)) - (y(b) - y(a)) * (x(c) - x(a));
    for (const [k, n] of (turn > 0 ? [a, b, c] : [a, c, b]).entries()) {
      if (k) maskContext.lineTo(x(n), y(n));
      else maskContext.moveTo(x(n), y(n));
    }
  }
  maskContext.fill("nonzero");
  const loop = longestContour(maskContext.getImageData(0, 0, MASK_SIDE, MASK_SIDE).data);
  return smooth(resample(loop)).map(([u, v]) => [left + (u + 0.5 - 4) / scale, top + (v + 0.5 - 4) / scale]);
}

// Longest closed contour of an RGBA image at half coverage, by marching squares; pixel centres are whole numbers.
function longestContour(rgba) {
  const alpha = (place) => rgba[4 * place + 3] - 127.5, next = new Map(), at = new Map();
  // Crossing of the border between two neighbouring pixels; its key is unique.
  const crossing = (from, to) => {
    const low = Math.min(from, to), high = Math.max(from, to), key = 2 * low + (high - low === 1 ? 0 : 1);
    const share = alpha(low) / (alpha(low) - alpha(high)), u = low % MASK_SIDE, v = Math.floor(low / MASK_SIDE);
    at.set(key, high - low === 1 ? [u + share, v] : [u, v + share]);
    return key;
  };
  const inside = new Uint8Array(MASK_SIDE ** 2);
  for (let place = 0; place < inside.length; place++) inside[place] = rgba[4 * place + 3] > 127 ? 1 : 0;
  for (let place = 0; place < MASK_SIDE * (MASK_SIDE - 1) - 1; place++) { // the mask's border is empty
    const below = place + MASK_SIDE, count = inside[place] + inside[place + 1] + inside[below] + inside[below + 1];
    if (count === 0 || count === 4) continue;
    const ring = [place, place + 1, below + 1, below];
    for (let k = 0; k < 4; k++) { // enter where the ring goes inside, leave where it next goes outside
      if (inside[ring[k]] || !inside[ring[(k + 1) % 4]]) continue;
      let end = (k + 1) % 4;
      while (inside[ring[(end + 1) % 4]]) end = (end + 1) % 4;
      next.set(crossing(ring[k], ring[(k + 1) % 4]), crossing(ring[end], ring[(end + 1) % 4]));
    }
  }
  let longest = [];
  while (next.size) {
    const loop = [];
    for (let [key] = next.keys(); next.has(key); ) {
      const following = next.get(key);
      loop.push(at.get(key));
      next.delete(key);
      key = following;
    }
    if (loop.length > longest.length) longest = loop;
  }
  return longest;
}

// Equally spaced points of a closed line.
function resample(loop) {
  const after = (k) => loop[(k + 1) % loop.length];
  const lengths = loop.map(([x, y], k) => Math.hypot(after(k)[0] - x, after(k)[1] - y));
  const step = lengths.reduce((sum, length) => sum + length, 0) / OUTLINE_POINTS, out = [];
  for (let k = 0, before = 0; k < loop.length && out.length < OUTLINE_POINTS; before += lengths[k++]) {
    const a = loop[k], b = after(k);
    while (out.length < OUTLINE_POINTS && out.length * step <= before + lengths[k]) {
      const share = lengths[k] ? (out.length * step - before) / lengths[k] : 0;
      out.push([a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]);
    }
  }
  return out;
}

// Smooth a closed line without shrinking it: what the filter removes twice as much as once is added back.
function smooth(loop) {
  const pass = (line) => line.map((point, k) => {
    const before = line.at(k - 1), after = line[(k + 1) % line.length];
    return [0.25 * (before[0] + 2 * point[0] + after[0]), 0.25 * (before[1] + 2 * point[1] + after[1])];
  });
  const repeat = (line) => Array.from({ length: SMOOTHING }).reduce(pass, line);
  const once = repeat(loop), twice = repeat(once);
  return once.map((point, k) => [2 * point[0] - twice[k][0], 2 * point[1] - twice[k][1]]);
}
