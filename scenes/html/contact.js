"use strict";
// Contact of a round tool with the open cortex: nearest point, footprint of the force, resting place of the ball.
// Points are [x, y, z] in metres.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const along = (start, direction, length) => start.map((value, axis) => value + length * direction[axis]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const sizeOf = (a) => Math.sqrt(dot(a, a));
const pointAt = (points, number) => [points[3 * number], points[3 * number + 1], points[3 * number + 2]];

function nearestOnEdge(a, b, point) {
  const edge = minus(b, a), square = dot(edge, edge);
  return along(a, edge, square > 0 ? Math.min(Math.max(dot(minus(point, a), edge) / square, 0), 1) : 0);
}

// Ericson 2005, "Real-Time Collision Detection", section 5.1.5, as in sim/discretisation/footprint.py.
function nearestOnTriangle(a, b, c, point) {
  const first = minus(b, a), second = minus(c, a), offset = minus(point, a);
  const aa = dot(first, first), ab = dot(first, second), bb = dot(second, second);
  const pa = dot(offset, first), pb = dot(offset, second), area = aa * bb - ab * ab;
  const v = bb * pa - ab * pb, w = aa * pb - ab * pa;
  if (area > 0 && v >= 0 && w >= 0 && v + w <= area) return along(along(a, first, v / area), second, w / area);
  const found = [nearestOnEdge(a, b, point), nearestOnEdge(b, c, point), nearestOnEdge(c, a, point)];
  const far = found.map((one) => sizeOf(minus(one, point)));
  return found[far.indexOf(Math.min(...far))];
}

// Point, triangle and barycentric weights on a surface nearest to a point.
function nearestOnSurface({ points, triangles }, point) {
  let best = { far: Infinity };
  for (let t = 0; t < triangles.length; t += 3) {
    const corners = [0, 1, 2].map((k) => pointAt(points, triangles[t + k]));
    const found = nearestOnTriangle(...corners, point), far = sizeOf(minus(found, point));
    if (far < best.far) best = { point: found, far, corners, vertices: [...triangles.subarray(t, t + 3)] };
  }
  const [a, b, c] = best.corners, normal = cross(minus(b, a), minus(c, a)), square = dot(normal, normal);
  const share = (p, q) => dot(cross(minus(p, best.point), minus(q, best.point)), normal) / square;
  return { point: best.point, vertices: best.vertices, weights: [share(b, c), share(c, a), share(a, b)] };
}

// Shares of the force at the surface's points: the integral of sqrt(1 - |x - point|^2 / radius^2), as in
// sim/discretisation/footprint.py, by the centroids of n^2 equal parts of every triangle.
function footprintWeights({ points, triangles }, point, radius) {
  const weights = new Float64Array(points.length / 3), ratio = 0.12, fewest = 8;
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => pointAt(points, triangles[t + k]));
    const start = minus(a, point), first = minus(b, a), second = minus(c, a);
    if (sizeOf(minus(nearestOnTriangle(a, b, c, point), point)) >= radius) continue;
    const longest = Math.max(sizeOf(first), sizeOf(second), sizeOf(minus(first, second)));
    let n = fewest;
    while (longest > ratio * radius * n) n *= 2;
    const sums = [0, 0, 0];
    for (const third of [1 / 3, 2 / 3]) { // upright and rotated parts
      const rows = third > 0.5 ? n - 1 : n;
      for (let i = 0; i < rows; i++) {
        for (let j = 0; j < rows - i; j++) {
          const y = (i + third) / n, z = (j + third) / n, at = along(along(start, first, y), second, z);
          const height = Math.sqrt(Math.max(radius * radius - dot(at, at), 0));
          sums[0] += (1 - y - z) * height;
          sums[1] += y * height;
          sums[2] += z * height;
        }
      }
    }
    const scale = sizeOf(cross(first, second)) / (n * n);
    sums.forEach((sum, k) => (weights[triangles[t + k]] += scale * sum));
  }
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  return weights.map((weight) => weight / total);
}

// Lowest point of a ball that comes down a line through a point and rests on a surface, by samples of the surface.
function restingTip({ points, triangles }, through, inward, radius) {
  let first = Infinity;
  const samples = 5;
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => minus(pointAt(points, triangles[t + k]), through));
    if (sizeOf(a) > 4 * radius) continue; // too far to touch
    for (let i = 0; i <= samples; i++) {
      for (let j = 0; j <= samples - i; j++) {
        const at = along(along(a, minus(b, a), i / samples), minus(c, a), j / samples), down = dot(at, inward);
        const room = radius * radius - dot(at, at) + down * down;
        if (room >= 0) first = Math.min(first, down - Math.sqrt(room));
      }
    }
  }
  return first < Infinity ? along(through, inward, first + radius) : through;
}
