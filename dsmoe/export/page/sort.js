// A worker that sorts Gaussians by their depth. First message: their positions, Float32Array of 3 numbers each. Each
// later one: [x, y, z, w], the row of the world-to-view matrix that gives the depth; the answer is {row, order}.

let positions = null;

onmessage = ({data}) => {
  if (positions === null) {
    positions = data;
    return;
  }
  const order = frontToBack(positions, data);
  postMessage({row: data, order}, [order.buffer]);
};

// The Gaussians beyond the near plane. Radix sort of the depths' bits: positive floats compare as integers do.
function frontToBack(positions, [x, y, z, w]) {
  const near = 0.2, count = positions.length / 3;
  const depths = new Float32Array(count);
  let order = new Uint32Array(count), kept = 0;
  for (let i = 0; i < count; i++) {
    depths[i] = x * positions[3 * i] + y * positions[3 * i + 1] + z * positions[3 * i + 2] + w;
    if (depths[i] > near) order[kept++] = i;
  }
  order = order.subarray(0, kept);
  const bits = new Uint32Array(depths.buffer);
  for (const shift of [0, 16]) {
    const begins = new Uint32Array(65537), sorted = new Uint32Array(kept);
    for (const i of order) begins[((bits[i] >>> shift) & 65535) + 1]++;
    for (let digit = 0; digit < 65536; digit++) begins[digit + 1] += begins[digit];
    for (const i of order) sorted[begins[(bits[i] >>> shift) & 65535]++] = i;
    order = sorted;
  }
  return order;
}
