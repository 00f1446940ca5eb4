"use strict";
// The fast model of the page: its arrays, and its result for one load.

const TYPES = { f4: Float32Array, f8: Float64Array, i4: Int32Array, u2: Uint16Array, u1: Uint8Array };

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

// Arrays of the scene, its open cortex, and the function from one load (point [m], force [N], footprint radius [m]) to
// the model's outputs. `text` holds the arrays as the page has them.
async function openModel(scene, text) {
  const arrays = {}, constants = {};
  for (const [name, { shape, data }] of Object.entries(await decode(text, scene.arrays))) {
    if (name.startsWith("constant_")) constants[name] = { shape, data: Float64Array.from(data) };
    else arrays[name] = data;
  }
  const graph = buildGraph(scene.graph, constants);
  const surface = { points: arrays.patch, triangles: arrays.patchTriangles };
  const row = (values, shape) => ({ shape: [1, ...shape], data: Float64Array.from(values) });
  function solve(point, force, footprint) {
    const inputs = { point: row(point, [3]), force: row(force, [3]), footprint: row([footprint], []) };
    if (scene.graph.inputs.includes("weight")) {
      inputs.weight = row(footprintWeights(surface, point, footprint), [surface.points.length / 3]);
    }
    return graph(inputs);
  }
  return { arrays, surface, solve };
}
