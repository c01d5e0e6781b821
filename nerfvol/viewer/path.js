// The camera path and the crop box of the page's panel; what it shows and where one looks are view.js's.
"use strict";

const looped = () => $("loop").checked;
function addKey() {
  state.keys.push({ camera: structuredClone(state.camera), seconds: 2 });
  list();
}
function list() {
  $("keys").replaceChildren(...state.keys.map((key, i) => {
    const item = document.createElement("li");
    const button = (text, label, act) => {
      const b = Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick: () => (act(), list()) });
      b.setAttribute("aria-label", `${label} ${i + 1}`);
      item.append(b);
    };
    const swap = (j) => { if (state.keys[j]) [state.keys[i], state.keys[j]] = [state.keys[j], state.keys[i]]; };
    button(`View ${i + 1}`, "Go to view", () => look(structuredClone(key.camera)));
    const seconds = Object.assign(document.createElement("input"), { type: "number", min: 0.1, step: 0.1, value: key.seconds });
    seconds.setAttribute("aria-label", `Seconds after view ${i + 1}`);
    seconds.onchange = () => (key.seconds = clamp(Number(seconds.value) || 2, 0.1, 600));
    item.append(seconds);
    button("↑", "Earlier: view", () => swap(i - 1));
    button("↓", "Later: view", () => swap(i + 1));
    button("⟳", "Replace by what is seen: view", () => (key.camera = structuredClone(state.camera)));
    button("×", "Remove view", () => state.keys.splice(i, 1));
    return item;
  }));
}
function stop() {
  state.playing = null;
  $("play").textContent = "Play";
}
function play() {
  if (state.playing || !state.keys.length) return stop();
  const playing = (state.playing = { started: performance.now() });
  $("play").textContent = "Stop";
  const step = () => {
    if (state.playing !== playing) return;
    const total = pathSeconds(state.keys, looped()), seconds = (performance.now() - playing.started) / 1000;
    if (!looped() && seconds >= total) stop();
    look(pathCamera(state.keys, looped() ? seconds % Math.max(total, 1e-3) : Math.min(seconds, total), looped()));
    requestAnimationFrame(step);
  };
  step();
}
const pathNow = () => pathDocument(state.keys, looped(), clamp(Number($("fps").value) || 30, 1, 120), Number($("width").value) || 1200, Number($("height").value) || 800);
$("add").onclick = addKey;
$("play").onclick = play;
$("store").onclick = () => state.keys.length ? download(new Blob([JSON.stringify(pathNow())], { type: "application/json" }), "path.json") : (status.textContent = "Add a view first");
$("load").onclick = () => $("paths").click();
$("paths").onchange = async () => {
  try { readPath(JSON.parse(await $("paths").files[0].text())); } catch { status.textContent = "This is no camera path"; }
};
function readPath(document_) {
  const distance = norm(sub(first.position, first.pivot)), w = document_.w || 1200, h = document_.h || w;
  state.keys = document_.keyframes || document_.frames.map((frame) => {
    const focal_ = frame.fl_x || document_.fl_x || (0.5 * w) / Math.tan((frame.camera_angle_x || document_.camera_angle_x || 0.6911) / 2);
    return { camera: fromMatrix(frame.transform_matrix, 2 * Math.atan((0.5 * Math.min(w, h)) / focal_), distance), seconds: 0.5 };
  });
  $("loop").checked = Boolean(document_.loop);
  list();
}

// ------------------------------------------------------------------ the crop box
const SIDES = ["x", "y", "z"], around = settings.box;
let cropped = null, cropBox = null;
function crop(box) {
  cropBox = box;
  SIDES.forEach((side, k) => [0, 1].forEach((end) => {
    const given = Object.assign($(side + end), { min: around[0][k], max: around[1][k], step: "any" });
    given.value = (box || around)[end][k];
  }));
  const words = box?.flat().map((x) => Number(x.toPrecision(4))).join(",");
  $("box").textContent = box ? `nerfvol export FILE --crop=${words}` : "Nothing is cropped";
  clearTimeout(cropped);
  cropped = setTimeout(() => {
    drawing?.crop(box);
    changed();
  }, 60);
}
SIDES.forEach((side, k) => [0, 1].forEach((end) => ($(side + end).oninput = () => {
  const box = [0, 1].map((e) => SIDES.map((name) => Number($(name + e).value)));
  box[end][k] = end ? Math.max(box[1][k], box[0][k]) : Math.min(box[0][k], box[1][k]);
  const wide = box[0].every((x, i) => x <= around[0][i]) && box[1].every((x, i) => x >= around[1][i]);
  crop(wide ? null : box);
})));
$("uncrop").onclick = () => crop(null);
if (around) crop(null);
