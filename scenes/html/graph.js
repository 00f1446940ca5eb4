"use strict";
// Evaluation of a traced model: operators named as in ONNX, on arrays {shape, data} of doubles.

const countOf = (shape) => shape.reduce((product, length) => product * length, 1);

const filled = (shape, value = 0) => ({ shape, data: new Float64Array(countOf(shape)).fill(value) });

function stridesOf(shape) {
  const strides = new Array(shape.length).fill(1);
  for (let axis = shape.length - 2; axis >= 0; axis--) strides[axis] = strides[axis + 1] * shape[axis + 1];
  return strides;
}

// Offsets of all elements of a shape, in order, in an array with these strides.
function offsetsOf(shape, strides) {
  const offsets = new Int32Array(countOf(shape)), index = new Array(shape.length).fill(0);
  let offset = 0;
  for (let place = 0; place < offsets.length; place++) {
    offsets[place] = offset;
    for (let axis = shape.length - 1; axis >= 0; axis--) {
      offset += strides[axis];
      if (++index[axis] < shape[axis]) break;
      offset -= strides[axis] * shape[axis];
      index[axis] = 0;
    }
  }
  return offsets;
}

// Strides by which an array is read as one of a larger shape; repeated axes have stride 0.
function broadcastStrides(from, shape) {
  const strides = stridesOf(from), extra = shape.length - from.length;
  return shape.map((_, axis) => (axis < extra || from[axis - extra] === 1 ? 0 : strides[axis - extra]));
}

function elementwise(compute, inputs) {
  const rank = Math.max(...inputs.map((input) => input.shape.length));
  const lengthAt = (input, axis) => input.shape[axis - rank + input.shape.length] ?? 1;
  const shape = Array.from({ length: rank }, (_, axis) => Math.max(...inputs.map((input) => lengthAt(input, axis))));
  const out = filled(shape), [first, second, third] = inputs.map((input) => {
    if (input.data.length === out.data.length) return (place) => input.data[place];
    if (input.data.length === 1) return () => input.data[0];
    const offsets = offsetsOf(shape, broadcastStrides(input.shape, shape));
    return (place) => input.data[offsets[place]];
  });
  for (let place = 0; place < out.data.length; place++) {
    out.data[place] = compute(first(place), second?.(place), third?.(place));
  }
  return out;
}

function reduce(input, axes, keep, start, combine) {
  const kept = input.shape.map((length, axis) => (axes.includes(axis) ? 1 : length));
  const offsets = offsetsOf(input.shape, broadcastStrides(kept, input.shape)), out = filled(kept, start);
  input.data.forEach((value, place) => (out.data[offsets[place]] = combine(out.data[offsets[place]], value)));
  return { shape: keep ? kept : kept.filter((_, axis) => !axes.includes(axis)), data: out.data };
}

function multiply(left, right) {
  const [inner, width = 1] = right.shape, out = filled([...left.shape.slice(0, -1), ...right.shape.slice(1)]);
  for (let row = 0; row * inner < left.data.length; row++) {
    for (let k = 0; k < inner; k++) {
      const factor = left.data[row * inner + k];
      if (factor === 0) continue; // most nodes carry no force
      for (let j = 0; j < width; j++) out.data[row * width + j] += factor * right.data[k * width + j];
    }
  }
  return out;
}

function sumProducts(equation, left, right) {
  const [inputs, result] = equation.split("->"), names = inputs.split(",");
  const letters = [...new Set(inputs.replace(",", ""))], lengths = {};
  [left, right].forEach((input, k) => [...names[k]].forEach((letter, axis) => (lengths[letter] = input.shape[axis])));
  const shapeOf = (text) => [...text].map((letter) => lengths[letter]);
  const [a, b, c] = [...names, result].map((text) => {
    const strides = stridesOf(shapeOf(text));
    return offsetsOf(letters.map((one) => lengths[one]), letters.map((one) => strides[text.indexOf(one)] ?? 0));
  });
  const out = filled(shapeOf(result));
  a.forEach((_, place) => (out.data[c[place]] += left.data[a[place]] * right.data[b[place]]));
  return out;
}

function gather(input, index, axis) {
  const inner = countOf(input.shape.slice(axis + 1)), outer = countOf(input.shape.slice(0, axis));
  const out = filled([...input.shape.slice(0, axis), ...index.shape, ...input.shape.slice(axis + 1)]);
  for (let row = 0, place = 0; row < outer; row++) {
    for (const number of index.data) {
      const start = (row * input.shape[axis] + number) * inner;
      for (let k = 0; k < inner; k++) out.data[place++] = input.data[start + k];
    }
  }
  return out;
}

function concatenate(inputs, axis) {
  const shape = [...inputs[0].shape], lengths = inputs.map((input) => countOf(input.shape.slice(axis)));
  shape[axis] = inputs.reduce((sum, input) => sum + input.shape[axis], 0);
  const out = filled(shape), outer = countOf(shape.slice(0, axis));
  for (let row = 0, place = 0; row < outer; row++) {
    inputs.forEach((input, k) => {
      out.data.set(input.data.subarray(row * lengths[k], (row + 1) * lengths[k]), place);
      place += lengths[k];
    });
  }
  return out;
}

function smallestIndex(input, axis) {
  const out = reduce(input, [axis], false, 0, () => 0), strides = stridesOf(input.shape);
  const starts = offsetsOf(out.shape, strides.filter((_, k) => k !== axis));
  starts.forEach((start, place) => {
    for (let k = 1; k < input.shape[axis]; k++) {
      const best = input.data[start + out.data[place] * strides[axis]];
      if (input.data[start + k * strides[axis]] < best) out.data[place] = k;
    }
  });
  return out;
}

function transpose(input) {
  const shape = [...input.shape].reverse(), offsets = offsetsOf(shape, stridesOf(input.shape).reverse());
  return { shape, data: Float64Array.from(offsets, (place) => input.data[place]) };
}

function reshape({ data }, lengths) {
  const known = lengths.filter((length) => length >= 0);
  return { shape: [...lengths].map((length) => (length < 0 ? data.length / countOf(known) : length)), data };
}

const FUNCTIONS = {
  Add: (a, b) => a + b, Sub: (a, b) => a - b, Mul: (a, b) => a * b, Div: (a, b) => a / b, Pow: Math.pow,
  Max: (a, b) => Math.max(a, b), Min: (a, b) => Math.min(a, b), Neg: (a) => -a, Abs: Math.abs, Sqrt: Math.sqrt,
  Exp: Math.exp, Log: Math.log, Tanh: Math.tanh, Asin: Math.asin, Greater: (a, b) => +(a > b), Less: (a, b) => +(a < b),
  Equal: (a, b) => +(a === b), Where: (condition, yes, no) => (condition ? yes : no),
};

const OPERATORS = {
  MatMul: (_, left, right) => multiply(left, right),
  Einsum: ({ equation }, left, right) => sumProducts(equation, left, right),
  Gather: ({ axis }, input, index) => gather(input, index, axis),
  Concat: ({ axis }, ...inputs) => concatenate(inputs, axis),
  Transpose: (_, input) => transpose(input),
  Reshape: (_, input, lengths) => reshape(input, lengths.data),
  Unsqueeze: (_, { shape, data }, axes) => ({ shape: shape.toSpliced(axes.data[0], 0, 1), data }), // of one axis
  ArgMin: ({ axis }, input) => smallestIndex(input, axis),
  ReduceSum: ({ keepdims }, input, axes) => reduce(input, [...axes.data], keepdims, 0, (sum, value) => sum + value),
  ReduceMin: ({ keepdims, axes }, input) => reduce(input, axes, keepdims, Infinity, Math.min),
  ReduceMax: ({ keepdims, axes }, input) => reduce(input, axes, keepdims, -Infinity, Math.max),
  Cast: (_, input) => input, // all numbers are doubles here
  Identity: (_, input) => input,
};

// Function from inputs to outputs, both arrays by name, of a graph with these constants.
function buildGraph({ outputs, nodes }, constants) {
  return (inputs) => {
    const values = { ...constants, ...inputs };
    for (const [kind, names, out, attributes] of nodes) {
      const given = names.map((name) => values[name]);
      values[out] = kind in FUNCTIONS ? elementwise(FUNCTIONS[kind], given) : OPERATORS[kind](attributes, ...given);
    }
    return Object.fromEntries(outputs.map((name) => [name, values[name]]));
  };
}
