// A worker of a page: one copy of the model, which draws rows of the picture that the page asks for.
"use strict";

let engine = null, latest = -1, box = null;
const clock = new MessageChannel();

// Lets messages that wait be handled.
function breathe() {
  return new Promise((resolve) => {
    clock.port1.onmessage = resolve;
    clock.port2.postMessage(0);
  });
}

async function draw(job) {
  const { id, view, rows, output, near, far } = job, started = performance.now();
  let slice = started;
  if (!rows.length) return self.postMessage({ type: "done", id, ms: 0, depths: [0, 0], strips: [] });
  engine.begin(view, rows[0], rows[rows.length - 1] + 1);
  const strips = [];
  for (const row of rows) {
    engine.draw(row);
    if (output < 0) continue;
    const strip = { row, pixels: engine.shade(row, output, near, far).buffer };
    if (job.whole) strips.push(strip);
    else self.postMessage({ type: "strip", id, ...strip }, [strip.pixels]);
    if (performance.now() - slice < 15) continue;
    await breathe();
    if (latest > id) return self.postMessage({ type: "dropped", id });
    slice = performance.now();
  }
  const depths = view.outputs.includes("depth") ? engine.depths(rows) : [0, 0];
  const floats = output < 0 ? engine.floats("rgb").buffer : null;
  const all = strips.map((strip) => strip.pixels);
  self.postMessage({ type: "done", id, ms: performance.now() - started, depths, strips, floats }, all);
}

let opened = false, edition = 0;
function ready() {
  if (!opened) self.postMessage({ type: "opened", edition, bytes: engine.wasm.memory.buffer.byteLength });
  opened = true;
}

function give(name) {
  const buffers = engine.part(name);
  self.postMessage({ type: "part", edition, name, buffers }, buffers);
}

let queue = Promise.resolve();

const handlers = {
  // Several workers share the work: each makes `parts` of an octree and sends them to the others, by way of the page.
  async open({ module, bytes, parts, alone, ...job }) {
    edition = job.edition;
    engine = null;  // the old one's memory goes first
    opened = false;
    engine = await Engine.open(module, bytes, parts.filter((name) => alone || name !== "nodes"));
    engine.crop(box);
    if (!engine.lacks || alone) return ready();
    if (parts.includes("corners")) give("corners");
    if (engine.complete) ready();
  },
  async give({ name, ...job }) {
    if (job.edition === edition) give(name);
  },
  async take({ name, buffers, ...job }) {
    if (job.edition !== edition) return;
    engine.take(name, buffers);
    if (engine.complete) ready();
  },
  async nodes(job) {
    if (job.edition !== edition) return;
    engine.makeNodes();
    give("nodes");
  },
  async draw(job) {
    if (latest <= job.id && engine) await draw(job);
    else self.postMessage({ type: "dropped", id: job.id });
  },
  async crop(job) {
    box = job.box;
    if (engine) engine.crop(box);
  },
  async pick({ id, view, x, y }) {
    self.postMessage({ type: "picked", id, distance: engine ? engine.pick(view, x, y) : 0 });
  },
};

self.onmessage = ({ data }) => {
  if (data.type === "draw") latest = data.id;
  queue = queue.then(() => handlers[data.type](data)).catch((error) => {
    const known = error instanceof ModelError;
    self.postMessage({ type: "failed", sentence: known ? error.message : `The model cannot be drawn: ${error.message}` });
  });
};
