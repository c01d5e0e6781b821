// The page: pointers, keys and buttons change the camera; draw.js makes pictures of it.
"use strict";

const $ = (id) => document.getElementById(id);
const settings = JSON.parse($("settings").textContent);
const canvas = $("canvas"), status = $("status");
const up = unit(settings.orbit.up || [0, 0, 1]);
const first = orbitCamera(settings.orbit);
const hex = (rgb) => "#" + rgb.map((x) => Math.round(255 * clamp(x, 0, 1)).toString(16).padStart(2, "0")).join("");
const state = { camera: fromFragment(location.hash) || first, background: [...settings.background], keys: [], held: new Set(), playing: null };
let drawing = null, model = null, failed = false;

// ------------------------------------------------------------------ the model
async function decode(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  return new Uint8Array(await (await fetch("data:application/octet-stream;base64," + text)).arrayBuffer());
}

// The model is the last thing in the file; the interface is there before it.
const loaded = new Promise((done) => (document.readyState === "loading" ? document.addEventListener("DOMContentLoaded", done) : done()));

function inflate(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

async function modelBytes() {
  await loaded;
  performance.mark("loaded");
  const element = $("model");
  if (!element) throw new ModelError("The model in this page is missing: the file is cut off.");
  const text = element.textContent;
  try {
    return await decode(text.trim());
  } catch {
    throw new ModelError("The model in this page is cut off or damaged.");
  }
}

function fault(sentence) {
  failed = true;
  status.className = "fault";
  status.textContent = sentence;
}

async function open() {
  if (typeof WebAssembly !== "object" || typeof DecompressionStream !== "function" || typeof OffscreenCanvas !== "function")
    throw new ModelError("This browser is too old for this page: it needs one of 2023 or later.");
  const kernels = await inflate(await decode($("kernels").textContent.trim()));
  const [module, bytes] = await Promise.all([WebAssembly.compile(kernels), remote ? remote.model() : modelBytes()]);
  model = bytes;
  performance.mark("decoded");
  const { document: described } = readArrays(bytes);  // says at once what is cut off
  const memory = navigator.deviceMemory || 8, many = bytes.length > 2e7 && memory < 8 ? 2 : 4;
  const count = clamp(Math.min(navigator.hardwareConcurrency || 2, many), 1, 4);
  drawing = new Drawing(canvas, described.format === "nerfvol splats", fault);
  drawing.range = settings.depths;
  drawing.onpicture = shown;
  await drawing.open($("worker").textContent, module, bytes, count);
  performance.mark("opened");
  changed();
  if (!remote) return;
  const distance = (m) => Math.max(norm(sub([m[0][3], m[1][3], m[2][3]], first.pivot)), 1e-6);
  remote.build($("remote"), { look, path: pathNow, box: () => cropBox, distance, camera: () => state.camera, extent }).catch((error) => fault(error.message));
  remote.follow(async (newer) => {
    drawing.isSplats = readArrays(newer).document.format === "nerfvol splats";
    model = newer;
    await drawing.load(module, newer);
    drawing.request(state.camera, state.background);
  });
}

function shown(frame) {
  $("poster").hidden = true;
  if (failed) return;
  const size = `${frame.width} × ${frame.height}`;
  status.textContent = frame.moving ? size : "";
  const range = $("range");
  range.hidden = drawing.output !== 2;
  if (drawing.range) range.textContent = `Light: ${drawing.range[0].toPrecision(3)}, dark: ${drawing.range[1].toPrecision(3)} scene units`;
}

let fragment = null;
function changed() {
  if (!drawing || failed) return;
  remote?.moved?.();
  drawing.request(state.camera, state.background);
  clearTimeout(fragment);
  fragment = setTimeout(() => {
    try { history.replaceState(null, "", toFragment(state.camera)); } catch { /* a frame without an address */ }
  }, 200);
  $("fov").value = Math.round((state.camera.fov * 180) / Math.PI);
  $("degrees").textContent = `${$("fov").value}°`;
}

function look(camera) {
  state.camera = camera;
  changed();
}

// ------------------------------------------------------------------ pointers
const pointers = new Map();
const place = (event) => [event.clientX - canvas.getBoundingClientRect().left, event.clientY - canvas.getBoundingClientRect().top];
const extent = () => [canvas.clientWidth, canvas.clientHeight];
const QUARTER = Math.PI / 2;

function dragged(dx, dy, pan) {
  const [width, height] = extent(), turns = (2 * QUARTER) / Math.min(width, height);
  look(pan ? panned(state.camera, dx, dy, width, height) : orbited(state.camera, -dx * turns, -dy * turns, up));
}

let pressed = null;  // where a pointer went down that has not moved
canvas.addEventListener("pointerdown", (event) => {
  stop();
  pressed = place(event);
  try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer that is gone already */ }
  pointers.set(event.pointerId, place(event));
});
canvas.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId), now = place(event);
  if (!before) return;
  pointers.set(event.pointerId, now);
  const [dx, dy] = sub(now, before);
  if (pressed && norm(sub(now, pressed)) > 3) pressed = null;
  if (pointers.size === 1) return dragged(dx, dy, event.buttons & 6 || event.shiftKey);
  const other = [...pointers].find(([id]) => id !== event.pointerId)[1], apart = (p) => Math.hypot(...sub(p, other)) + 1;
  const [width, height] = extent(), middle = scale(add(now, other), 0.5);
  look(panned(zoomed(state.camera, apart(before) / apart(now), ...middle, width, height), dx / 2, dy / 2, width, height));
});
canvas.addEventListener("pointerup", (event) => pressed && remote?.clicked?.(...place(event)));
for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  stop();
  const pixels = event.deltaY * (event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1);
  look(zoomed(state.camera, Math.exp(clamp(pixels, -300, 300) * 0.0012), ...place(event), ...extent()));
}, { passive: false });
canvas.addEventListener("dblclick", async (event) => {
  const camera = state.camera, [x, y] = place(event);
  const distance = await drawing.pick(camera, x, y);
  if (!(distance > 0)) return;
  const pivot = add(camera.position, scale(unit(ray(camera, x, y, ...extent())), distance));
  look({ ...state.camera, pivot });
  status.textContent = "Turns about this point now";
});

// ------------------------------------------------------------------ keys
const FLY = { w: [0, 0, -1], s: [0, 0, 1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
const STEP = Math.PI / 36;
const TURN = { ArrowLeft: [STEP, 0], ArrowRight: [-STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
const zoom = (factor) => look(zoomed(state.camera, factor, ...scale(extent(), 0.5), ...extent()));

canvas.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (FLY[key]) hold(key);
  else if (TURN[key]) look(orbited(state.camera, ...TURN[key], up));
  else if (key === "+" || key === "=") zoom(0.9);
  else if (key === "-") zoom(1 / 0.9);
  else if (key === "r") look(first);
  else if ("1234".includes(key)) document.querySelectorAll("[name=output]")[key - 1].click();
  else if (key === "k") addKey();
  else if (key === " ") play();
  else return;
  event.preventDefault();
});
canvas.addEventListener("keyup", (event) => state.held.delete(event.key.toLowerCase()));
canvas.addEventListener("blur", () => state.held.clear());

function hold(key) {
  stop();
  if (state.held.has(key)) return;
  state.held.add(key);
  if (state.held.size === 1) fly(performance.now());
}

// One distance to the pivot a second; a touch is a sixtieth of one at least.
function fly(before) {
  if (!state.held.size) return;
  const now = performance.now(), seconds = clamp((now - before) / 1000, 1 / 60, 0.1);
  const steps = [...state.held].map((key) => FLY[key]).reduce(add, [0, 0, 0]);
  const speed = norm(sub(first.position, first.pivot));
  look(flown(state.camera, scale(steps, seconds * speed)));
  requestAnimationFrame(() => fly(now));
}

// ------------------------------------------------------------------ buttons
$("menu").onclick = () => {
  const opened = $("panel").hidden;
  $("panel").hidden = !opened;
  $("menu").setAttribute("aria-expanded", String(opened));
};
document.addEventListener("keydown", (event) => event.key === "Escape" && !$("panel").hidden && $("menu").click());
for (const radio of document.querySelectorAll("[name=output]")) radio.onchange = () => {
  if (drawing) drawing.output = Number(radio.value);
  changed();
};
function backdrop(rgb) {
  state.background = rgb;
  $("background").value = hex(rgb);
  changed();
}
$("background").oninput = () => backdrop([1, 3, 5].map((i) => parseInt($("background").value.slice(i, i + 2), 16) / 255));
$("white").onclick = () => backdrop([1, 1, 1]);
$("black").onclick = () => backdrop([0, 0, 0]);
$("background").value = hex(state.background);
$("fov").oninput = () => look({ ...state.camera, fov: ($("fov").value * Math.PI) / 180 });
$("reset").onclick = () => look(first);
$("link").onclick = async () => {
  const text = location.href.split("#")[0] + toFragment(state.camera);
  try { await navigator.clipboard.writeText(text); status.textContent = "Copied"; } catch { location.hash = toFragment(state.camera); }
};
window.addEventListener("hashchange", () => fromFragment(location.hash) && look(fromFragment(location.hash)));
window.addEventListener("resize", changed);

function download(blob, name) {
  const a = document.createElement("a");
  a.href = URL.createObjectURL(blob);
  a.download = name;
  a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 10000);
}
$("save").onclick = async () => {
  const [width, height] = ["width", "height"].map((id) => clamp(Math.round(Number($(id).value)) || 800, 16, 4096));
  status.textContent = "Drawing …";
  const { buffer } = await drawing.picture(state.camera, width, height, state.background);
  download(await buffer.canvas.convertToBlob({ type: "image/png" }), `${settings.name}.png`);
  status.textContent = "";
};
$("file").onclick = () => download(new Blob([model], { type: "application/octet-stream" }), `${settings.name}.safetensors`);

// What tests and notebooks ask.
window.nerfvol = {
  get camera() { return structuredClone(state.camera); },
  set camera(camera) { look(camera); },
  get drawing() { return drawing; },
  get path() { return pathNow(); },
  first, state, readPath, crop,
};
window.nerfvol.ready = open().catch((error) => fault(error instanceof ModelError ? error.message : `This page cannot be shown: ${error.message}`));
