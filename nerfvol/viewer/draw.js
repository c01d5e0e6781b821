// Pictures from the workers: small and quick while something moves, whole and fine once it stands still.
"use strict";

const MOVING_MS = 50, SETTLE_MS = 120, LEAST_WIDTH = 160, MOST_PIXELS = 1.8e6, FINE_LOD = 0.8;
const OUTPUTS_OF = [[], [], ["depth"], ["normal"]];

class Drawing {
  // canvas: where pictures go; isSplats: they are shared out in bands, since each worker sorts what its rows need.
  constructor(canvas, isSplats, onFault) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.isSplats = isSplats;
    this.onFault = onFault;
    this.workers = [];
    this.nextId = 1;
    this.pixels = 200 * 150;
    this.lod = 1.5;
    this.seen = 0;
    this.range = null;
    this.output = 0;
    this.eps = 1 / 255;
    this.stats = { pictures: 0, times: [], first: null, latency: [] };
    this.frame = this.pending = this.timer = null;
    this.waiting = new Map();
  }

  async open(source, module, bytes, count) {
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.shares = Array(count).fill(1 / count);
    this.workers = Array.from({ length: count }, () => new Worker(url));
    await this.load(module, bytes);
    URL.revokeObjectURL(url);
  }

  // The model in `bytes`, now; resolves once pictures of it can be drawn. Of an octree the first worker numbers the corners while the
  // second decodes the values. The second then draws, and gives the values to the others, who join as they have them; the first
  // makes the nodes of coarser levels before it does.
  async load(module, bytes) {
    const n = this.workers.length, shared = n > 1 && !this.isSplats, [maker, painter] = this.workers;
    const parts = this.workers.map((_, i) => (!shared ? ["corners", "values", "nodes"] : [["corners"], ["values"]][i] || []));
    const edition = (this.edition = (this.edition || 0) + 1);
    this.frame = null;
    this.active = [];
    this.loading = true;
    const ready = this.workers.map((worker, index) => new Promise((resolve) => {
      worker.onmessage = ({ data }) => {
        if (data.edition && data.edition !== edition) return;  // of the model before
        if (data.type === "part") return this.relay(worker, data);
        if (data.type !== "opened") return this.hear(worker, data);
        if (worker === maker && shared) worker.postMessage({ type: "nodes", edition });
        else this.active.push(worker);
        resolve();
      };
      worker.onerror = (event) => this.onFault(`The model cannot be drawn: ${event.message || "a worker did not start"}.`);
      worker.postMessage({ type: "open", edition, module, bytes, parts: parts[index], alone: !shared });
    }));
    await (shared ? ready[1] : Promise.all(ready));
    if (edition !== this.edition) return;
    this.loading = false;
    if (shared) setTimeout(() => painter.postMessage({ type: "give", edition, name: "values" }));  // after the picture that is asked for now
  }

  // A part of the octree from one worker to the others; the last one has the buffers themselves.
  relay(from, { edition, name, buffers }) {
    performance.mark(name);
    const others = this.workers.filter((worker) => worker !== from), last = others.pop();
    for (const worker of others) worker.postMessage({ type: "take", edition, name, buffers });
    last.postMessage({ type: "take", edition, name, buffers }, buffers);
    if (name === "nodes") this.active.push(from);
  }

  // Whether every worker draws, coarser levels among what they draw.
  get complete() {
    return this.active?.length === this.workers.length;
  }

  size() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const most = Math.min(ratio, Math.sqrt(MOST_PIXELS / (width * height)));
    return [Math.max(16, Math.round(width * most)), Math.max(16, Math.round(height * most))];
  }

  view(camera, width, height, lod, background) {
    const f = focal(camera, width, height);
    return { c2w: matrix(camera), fx: f, fy: f, cx: width / 2, cy: height / 2, width, height, background, eps: this.eps, lod,
      outputs: OUTPUTS_OF[this.output] };
  }

  // Something changed: draw `camera`. `at`: when, for the statistics.
  request(camera, background, at = performance.now()) {
    this.wanted = { camera, background, at };
    clearTimeout(this.timer);
    if (this.loading) return;
    if (this.frame && this.frame.moving) return void (this.pending = true);
    this.start(true);
  }

  start(moving) {
    const [full, tall] = this.size(), { camera, background } = this.wanted;
    const share = moving ? Math.min(1, Math.sqrt(Math.max(this.pixels, (LEAST_WIDTH * LEAST_WIDTH * tall) / full) / (full * tall))) : 1;
    const width = Math.max(16, Math.round(full * share)), height = Math.max(16, Math.round(tall * share));
    this.pending = false;
    this.draw({ moving, width, height, at: this.wanted.at, output: this.output,
      view: this.view(camera, width, height, moving ? this.lod : FINE_LOD, background) });
  }

  // Hands a frame {width, height, view, output, …} to the workers.
  draw(frame) {
    Object.assign(frame, { id: this.nextId++, got: 0, started: performance.now(), depths: [], workers: [...this.active], workerMs: [] });
    this.frame = frame;
    frame.buffer = new OffscreenCanvas(frame.width, frame.height).getContext("2d", { alpha: false });
    const [near, far] = this.range || [0, 1], rows = this.rowsOf(Math.ceil(frame.height / 16));
    frame.workers.forEach((worker, i) => worker.postMessage({ type: "draw", id: frame.id, view: frame.view, rows: rows[i],
      output: frame.output, near, far, whole: frame.moving }));
  }

  rowsOf(count) {
    const n = this.active.length, all = Array.from({ length: count }, (_, row) => row);
    if (!this.isSplats) return this.active.map((_, i) => all.filter((row) => row % n === i));
    let sum = 0;
    const ends = this.shares.map((share) => Math.round((sum += share) * count));
    return this.active.map((_, i) => all.slice(i ? ends[i - 1] : 0, i === n - 1 ? count : ends[i]));
  }

  hear(worker, data) {
    if (data.type === "failed") return this.onFault(data.sentence);
    if (data.type === "picked") return void this.waiting.get(data.id)?.(data.distance);
    const frame = this.frame;
    if (!frame || data.id !== frame.id || data.type === "dropped") return;
    if (data.type === "strip") this.put(frame, data);
    if (data.type !== "done") return;
    data.strips.forEach((strip) => this.put(frame, strip));
    const index = frame.workers.indexOf(worker);
    frame.workerMs[index] = data.ms;
    if (data.depths[1] > 0) frame.depths.push(data.depths);
    if (data.floats) (frame.floats ||= []).push([index, data.floats]);
    if (++frame.got === frame.workers.length) this.finish(frame);
  }

  put(frame, { row, pixels }) {
    const image = new ImageData(new Uint8ClampedArray(pixels), frame.width);
    frame.buffer.putImageData(image, 0, 16 * row);
    if (!frame.moving && !frame.resolve) {  // finer rows over the coarse picture of the same view
      if (this.canvas.width !== frame.width || this.canvas.height !== frame.height) this.resize(frame.width, frame.height);
      this.context.putImageData(image, 0, 16 * row);
    }
  }

  resize(width, height) {
    const old = new OffscreenCanvas(this.canvas.width, this.canvas.height);
    old.getContext("2d").drawImage(this.canvas, 0, 0);
    Object.assign(this.canvas, { width, height });
    this.context.drawImage(old, 0, 0, width, height);
  }

  finish(frame) {
    this.frame = null;
    if (frame.resolve) {
      frame.resolve(frame);
      return this.wanted && this.request(this.wanted.camera, this.wanted.background);
    }
    const now = performance.now(), old = this.range;
    if (frame.depths.length) {
      const found = [Math.min(...frame.depths.map((d) => d[0])), Math.max(...frame.depths.map((d) => d[1]))];
      const wide = [found[0] - 0.05 * (found[1] - found[0]), found[1] + 0.05 * (found[1] - found[0])];
      this.range = old && frame.moving ? old.map((x, i) => 0.7 * x + 0.3 * wide[i]) : wide;
    }
    if (frame.moving) {
      if (this.canvas.width !== frame.width || this.canvas.height !== frame.height)
        Object.assign(this.canvas, { width: frame.width, height: frame.height });
      this.context.drawImage(frame.buffer.canvas, 0, 0);
      this.measure(frame, now);
    }
    this.stats.first ??= now;
    this.stats.still = !frame.moving;
    this.onpicture?.(frame);
    if (this.pending) return this.start(true);
    const moved = !old || !this.range || Math.abs(old[1] - this.range[1]) > 0.01 * this.range[1];
    if (frame.moving) this.timer = setTimeout(() => this.start(false), SETTLE_MS);
    else if (frame.output === 2 && moved && !frame.again) {  // the same again, now that its range is known
      this.start(false);
      this.frame.again = true;
    }
  }

  // The next moving picture is as large as lets it be done in MOVING_MS; the first two are slow everywhere and do not count.
  measure(frame, now) {
    const ms = now - frame.started;
    this.stats.pictures++;
    this.stats.times.push(now);
    this.stats.latency.push(now - frame.at);
    if (++this.seen > 2) {
      this.pixels = clamp(this.pixels * clamp(MOVING_MS / ms, 0.6, 1.3), LEAST_WIDTH * LEAST_WIDTH * 0.5, MOST_PIXELS);
      this.lod = clamp(this.lod * (ms > 1.2 * MOVING_MS && frame.width <= 1.1 * LEAST_WIDTH ? 1.1 : 0.98), 1.5, 3);
    }
    if (!this.isSplats || frame.workerMs.some((x) => !x)) return;
    const speeds = this.shares.map((share, i) => share / frame.workerMs[i]), sum = speeds.reduce((a, b) => a + b);
    this.shares = this.shares.map((share, i) => 0.7 * share + 0.3 * (speeds[i] / sum));
  }

  // Only what lies in `box`, two corners in scene units; null: all. Pictures that are asked for afterwards show it.
  crop(box) {
    for (const worker of this.workers) worker.postMessage({ type: "crop", box });
  }

  // A picture of its own, at any size: resolves to {buffer, floats}. output -1: floats alone.
  picture(camera, width, height, background, output = this.output, lod = FINE_LOD) {
    clearTimeout(this.timer);
    const outputs = OUTPUTS_OF[Math.max(output, 0)];
    return new Promise((resolve) =>
      this.draw({ moving: false, width, height, output, view: { ...this.view(camera, width, height, lod, background), outputs }, resolve }));
  }

  pick(camera, x, y) {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight, id = this.nextId++;
    const view = { ...this.view(camera, width, height, FINE_LOD, [0, 0, 0]) };
    return new Promise((resolve) => {
      this.waiting.set(id, (distance) => (this.waiting.delete(id), resolve(distance)));
      this.active[0].postMessage({ type: "pick", id, view, x, y });
    });
  }
}
