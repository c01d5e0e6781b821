// Opens a model's file and draws it with the kernels (kernels/csrc/web.cpp). Runs in a worker of a page, or in Node.
"use strict";

const WANT = { depth: 1, median: 2, normal: 4 };
const FLOATS = { rgb: 0, trans: 1, depth: 2, median: 3, normal: 4 };
const FAULTS = {
  1: "a child is marked both as a node and as a leaf",
  2: "its masks do not make one tree",
  3: "it is deeper than 16 levels",
  4: "its masks make another number of vertices than it declares",
};

const PARTS = { corners: [0], values: [1], nodes: [2, 3] };

class ModelError extends Error {}

// The JSON document of a safetensors file, and a function that gives an array's bytes by name.
function readArrays(bytes) {
  const fault = (reason) => new ModelError(`The model in this page cannot be used: ${reason}.`);
  if (bytes.length < 9) throw fault("it is cut off");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const length = Number(view.getBigUint64(0, true));
  if (!(length > 0 && 8 + length <= bytes.length)) throw fault("it is cut off");
  let header, document;
  try {
    header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + length)));
    document = JSON.parse(header.__metadata__.nerfvol);
  } catch {
    throw fault("its header is damaged");
  }
  const data = bytes.subarray(8 + length);
  const read = (name) => {
    const entry = header[name];
    if (!entry || entry.dtype !== "U8") throw fault(`its array ${name} is missing`);
    const [from, to] = entry.data_offsets;
    if (!(from >= 0 && from <= to && to <= data.length)) throw fault("it is cut off");
    return data.subarray(from, to);
  };
  return { document, read, fault };
}

class Engine {
  // parts: which of "corners", "values" and "nodes" of an octree are made here; others come by `take`.
  static async open(module, bytes, parts = ["corners", "values", "nodes"]) {
    const nothing = () => 0;
    const imports = { wasi_snapshot_preview1: { fd_close: nothing, fd_seek: nothing, fd_write: nothing } };
    const engine = new Engine();
    engine.wasm = (await WebAssembly.instantiate(module, imports)).exports;
    engine.wasm._initialize();
    const file = readArrays(bytes);
    engine.document = file.document;
    const openers = { "nerfvol octree": "openOctree", "nerfvol splats": "openSplats" };
    const opener = openers[file.document.format];
    if (!opener || file.document.storage !== "compact") throw file.fault("it is of a kind that this page cannot draw");
    try {
      engine[opener](file, parts);
    } catch (error) {
      if (error instanceof ModelError) throw error;
      if (error instanceof TypeError) throw file.fault("its header is damaged");
      if (error instanceof RangeError || error instanceof WebAssembly.RuntimeError)
        throw new ModelError("This model needs more memory than the browser gives to a page.");
      throw error;
    }
    engine.isSplats = opener === "openSplats";
    return engine;
  }

  keep(bytes) {
    const at = this.wasm.reserve(Math.max(bytes.length, 1)) >>> 0;
    new Uint8Array(this.wasm.memory.buffer, at, bytes.length).set(bytes);
    return at;
  }

  // Calls `use(index, low, high)` with the two planes of each of `n` channels, `count` bytes each, one after the other.
  channels(n, count, file, use) {
    const planes = ["low", "high"].map(() => this.wasm.reserve(Math.max(count, 1)) >>> 0);
    for (let index = 0; index < n; ++index) {
      ["low", "high"].forEach((plane, i) => {
        const packed = file.read(`code${String(index).padStart(3, "0")}.${plane}`), at = this.keep(packed);
        const good = this.wasm.inflate(at, packed.length, planes[i], count);
        this.wasm.release(at);
        if (!good) throw file.fault("its numbers are damaged");
      });
      use(index, ...planes);
    }
    planes.forEach((plane) => this.wasm.release(plane));
  }

  openOctree(file, parts) {
    const d = file.document, codec = d.codec;
    const nodes = file.read("node_mask"), leaves = file.read("leaf_mask");
    if (nodes.length !== leaves.length || !codec) throw file.fault("its parts do not fit together");
    const code = this.wasm.octree_open(this.keep(nodes), this.keep(leaves), nodes.length, d.n_vertices, d.sh_degree,
      ...d.origin, d.size, d.density_scale);
    if (code) throw file.fault(FAULTS[code]);
    this.lacks = new Set(["corners", "values"]);
    if (parts.includes("corners")) {
      const wrong = this.wasm.octree_corners();
      if (wrong) throw file.fault(FAULTS[wrong]);
      this.lacks.delete("corners");
    }
    if (!parts.includes("values")) return;
    const channels = 1 + 3 * (d.sh_degree + 1) ** 2;
    this.channels(channels, d.n_vertices, file, (index, low, high) =>
      this.wasm.octree_channel(index, channels, low, high, codec.differences[index]));
    this.wasm.octree_rows(codec.density_step, codec.density_softness, codec.sh_step);
    this.lacks.delete("values");
    if (parts.includes("nodes")) this.makeNodes();
  }

  // Whether it can draw.
  get complete() {
    return !this.lacks || !this.lacks.size;
  }

  makeNodes() {
    const box = this.box;
    this.crop(null);  // nodes are made of all leaves
    this.wasm.octree_nodes();
    this.wasm.octree_finish();
    this.crop(box);
  }

  // Draws what lies in the box of corners box[0] and box[1], scene units, and nothing else; null: all.
  crop(box) {
    const corners = box ? box.flat() : [-1, -1, -1, 1, 1, 1].map((x) => x * 1e30), before = this.box;
    this.box = box;
    if (this.complete && (box || before)) this.wasm[this.isSplats ? "splats_crop" : "octree_crop"](...corners);
  }

  // A copy of a part of the octree, for others to take: a list of buffers.
  part(name) {
    return PARTS[name].map((number) => {
      const at = this.wasm.octree_part(number, 0) >>> 0;
      return this.wasm.memory.buffer.slice(at, at + (this.wasm.octree_part_bytes(number) >>> 0));
    });
  }

  take(name, buffers) {
    const row = 32 * [1, 1, 2, 4][this.document.sh_degree];
    PARTS[name].forEach((number, i) => {
      const at = this.wasm.octree_part(number, number === 3 ? buffers[i].byteLength / row : 0) >>> 0;
      new Uint8Array(this.wasm.memory.buffer, at, buffers[i].byteLength).set(new Uint8Array(buffers[i]));
    });
    this.lacks.delete(name);
    if (name === "nodes") this.wasm.octree_finish();
    if (this.complete) this.crop(this.box);
  }

  openSplats(file) {
    const d = file.document, c = d.codec, basis = (d.sh_degree + 1) ** 2;
    if (!c) throw file.fault("its parts do not fit together");
    this.wasm.splats_open(d.n, basis, d.mode === "mip" ? 1 : 0, ...d.origin, d.metadata.near);
    const target = (i) => {  // row of the parameters, and what a code counts there: splats/codec.py
      if (i < 3) return [i, 256 * c.position_step];
      if (i < 6) return [i - 3, c.position_step];
      if (i < 9) return [i - 3, c.scale_step];
      if (i < 12) return [i - 2, c.rotation_step];
      if (i === 12) return [10, c.logit_step];
      return [i - 2, (i - 13) % basis ? c.sh_step : c.dc_step];
    };
    this.channels(13 + 3 * basis, d.n, file, (index, low, high) => {
      const [row, factor] = target(index);
      this.wasm.splats_channel(row, low, high, c.differences[index], factor);
    });
    this.wasm.splats_finish(...c.middle, c.extent);
  }

  // Begins a picture. view: {c2w (16 numbers, row by row, OpenGL axes), fx, fy, cx, cy, width, height, background, eps, lod,
  // outputs (names of WANT)}; rows [first, last) of 16 pixels will be drawn.
  begin(view, first, last) {
    const m = view.c2w, wanted = (view.outputs || []).reduce((sum, name) => sum + (WANT[name] || 0), 0);
    const numbers = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10], m[3], m[7], m[11], view.fx, view.fy, view.cx,
      view.cy, view.width, view.height, ...view.background, view.eps, view.lod / Math.max(view.fx, view.fy), wanted];
    new Float64Array(this.wasm.memory.buffer, this.wasm.view() >>> 0, numbers.length).set(numbers);
    this.view = view;
    this.wasm.begin();
    this.wasm.prepare(first, last);
  }

  draw(row) {
    this.wasm.draw(row);
  }

  // A copy of a float output of the picture: rgb, trans, depth, median or normal.
  floats(name) {
    const count = this.view.width * this.view.height * (name === "rgb" || name === "normal" ? 3 : 1);
    return new Float32Array(this.wasm.memory.buffer, this.wasm.floats(FLOATS[name]) >>> 0, count).slice();
  }

  // RGBA bytes (a copy) of a row of 16 pixels' height; output: 0 colour, 1 opacity, 2 depth, 3 normals.
  shade(row, output, near, far) {
    const { width, height } = this.view, first = 16 * row * width, count = Math.min(16, height - 16 * row) * width;
    const at = this.wasm.shade(output, first, count, near, far) >>> 0;
    return new Uint8ClampedArray(this.wasm.memory.buffer, at + 4 * first, 4 * count).slice();
  }

  // Distance at which half the light through the pixel (x, y) of a view is stopped, scene units; 0 where it is not.
  pick(view, x, y) {
    const side = 16, small = { ...view, width: side, height: side, cx: view.cx - x + 0.5, cy: view.cy - y + 0.5, outputs: ["median"] };
    this.begin(small, 0, 1);
    this.draw(0);
    return this.floats("median")[0];
  }

  // Nearest and farthest depth among the opaque pixels of rows that were drawn, [0, 0] where there are none.
  depths(rows) {
    const { width, height } = this.view, depth = this.floats("depth"), trans = this.floats("trans"), seen = [];
    for (const row of rows)
      for (let i = 16 * row * width; i < Math.min(16 * row + 16, height) * width; i += 3)
        if (trans[i] < 0.5) seen.push(depth[i] / (1 - trans[i]));
    seen.sort((a, b) => a - b);
    return seen.length ? [seen[Math.floor(seen.length * 0.01)], seen[Math.floor(seen.length * 0.99)]] : [0, 0];
  }
}

if (typeof module !== "undefined") module.exports = { Engine, ModelError, readArrays };
