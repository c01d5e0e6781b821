// Cameras as numbers: position, rotation, pivot, field of view, and how drags, wheels and keys change them.
//
// Conventions are the library's: camera-to-world in OpenGL axes (x right, y up, looking down -z), pixel centres end in 1/2,
// quaternions (w, x, y, z). The field of view is the angle across the shorter side of the picture, radians.
"use strict";

const add = (a, b) => a.map((x, i) => x + b[i]);
const sub = (a, b) => a.map((x, i) => x - b[i]);
const scale = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scale(a, 1 / norm(a));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

function multiply(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

const conjugate = (q) => [q[0], -q[1], -q[2], -q[3]];
const turn = (axis, angle) => [Math.cos(angle / 2), ...scale(unit(axis), Math.sin(angle / 2))];
const rotate = (q, v) => multiply(multiply(q, [0, ...v]), conjugate(q)).slice(1);

// Columns (right, up, back) of a quaternion's matrix.
const axes = (q) => [rotate(q, [1, 0, 0]), rotate(q, [0, 1, 0]), rotate(q, [0, 0, 1])];

function quaternion(right, up, back) {  // of a rotation matrix's columns
  const m = [right, up, back], trace = m[0][0] + m[1][1] + m[2][2];
  let q;
  if (trace > 0) {
    q = [1 + trace, m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]];
  } else {
    const i = m[0][0] >= m[1][1] && m[0][0] >= m[2][2] ? 0 : m[1][1] >= m[2][2] ? 1 : 2, j = (i + 1) % 3, k = (i + 2) % 3;
    q = [m[j][k] - m[k][j], 0, 0, 0];
    q[1 + i] = 1 + m[i][i] - m[j][j] - m[k][k];
    q[1 + j] = m[i][j] + m[j][i];
    q[1 + k] = m[i][k] + m[k][i];
  }
  return unit(q);
}

function lookAt(eye, target, up) {
  const back = unit(sub(eye, target)), right = unit(cross(up, back));
  return quaternion(right, cross(back, right), back);
}

// The first camera of an orbit: nerfvol/cameras/camera.py, orbit.
function orbitCamera(orbit, azimuth) {
  const axis = unit(orbit.up || [0, 0, 1]), sizes = axis.map(Math.abs), least = sizes.indexOf(Math.min(...sizes));
  const start = unit(sub([0, 1, 2].map((k) => (k === least ? 1 : 0)), scale(axis, axis[least]))), side = cross(axis, start);
  const elevation = (orbit.elevation_deg * Math.PI) / 180;
  const angle = azimuth ?? ((orbit.azimuth_deg || 0) * Math.PI) / 180;
  const outward = add(scale(start, Math.cos(angle)), scale(side, Math.sin(angle)));
  const offset = add(scale(outward, Math.cos(elevation)), scale(axis, Math.sin(elevation)));
  const position = add(orbit.center, scale(offset, orbit.radius));
  const [width, height] = orbit.size || [1, 1];
  const across = Math.tan((orbit.camera_angle_x || 0.6911) / 2) * (Math.min(width, height) / width);
  return { position, rotation: lookAt(position, orbit.center, axis), pivot: [...orbit.center], fov: 2 * Math.atan(across) };
}

const focal = (camera, width, height) => (0.5 * Math.min(width, height)) / Math.tan(camera.fov / 2);

function matrix(camera) {  // camera to world, 16 numbers row by row
  const [r, u, b] = axes(camera.rotation), p = camera.position;
  return [r[0], u[0], b[0], p[0], r[1], u[1], b[1], p[1], r[2], u[2], b[2], p[2], 0, 0, 0, 1];
}

function fromMatrix(m, fov, pivotDistance) {
  const column = (k) => [m[0][k], m[1][k], m[2][k]], back = column(2), position = column(3);
  return { position, rotation: quaternion(column(0), column(1), back), pivot: sub(position, scale(back, pivotDistance)), fov };
}

// Depth of the pivot along the viewing axis; at least a little.
function pivotDepth(camera) {
  const back = axes(camera.rotation)[2];
  return Math.max(dot(sub(camera.position, camera.pivot), back), 1e-3 * norm(sub(camera.position, camera.pivot)), 1e-9);
}

// The direction through the point (x, y) of a picture, of depth 1 along the viewing axis.
function ray(camera, x, y, width, height) {
  const f = focal(camera, width, height), [right, up, back] = axes(camera.rotation);
  return sub(add(scale(right, (x - width / 2) / f), scale(up, -(y - height / 2) / f)), back);
}

// Where a point is in a picture, [x, y]; null: behind the camera.
function project(camera, point, width, height) {
  const [right, up, back] = axes(camera.rotation), d = sub(point, camera.position), depth = -dot(d, back);
  if (!(depth > 1e-9)) return null;
  const f = focal(camera, width, height);
  return [width / 2 + (f * dot(d, right)) / depth, height / 2 - (f * dot(d, up)) / depth];
}

// Around the pivot: `yaw` about the scene's up, `pitch` about the camera's right; the poles are kept at a distance.
function orbited(camera, yaw, pitch, up) {
  const [right, , back] = axes(camera.rotation), height = Math.asin(clamp(dot(back, up), -1, 1)), most = 1.55;
  const upright = dot(axes(camera.rotation)[1], up) >= 0 ? 1 : -1;
  const free = clamp(height + upright * -pitch, -Math.max(most, Math.abs(height)), Math.max(most, Math.abs(height)));
  const q = multiply(turn(up, yaw), turn(right, (height - free) * upright));
  const position = add(camera.pivot, rotate(q, sub(camera.position, camera.pivot)));
  return { ...camera, position, rotation: unit(multiply(q, camera.rotation)) };
}

// What is at the pivot's depth follows the pointer.
function panned(camera, dx, dy, width, height) {
  const unitsPerPixel = pivotDepth(camera) / focal(camera, width, height), [right, up] = axes(camera.rotation);
  const move = add(scale(right, -dx * unitsPerPixel), scale(up, dy * unitsPerPixel));
  return { ...camera, position: add(camera.position, move), pivot: add(camera.pivot, move) };
}

// `factor` times the distance to what is under the point (x, y), at the pivot's depth.
function zoomed(camera, factor, x, y, width, height) {
  const anchor = add(camera.position, scale(ray(camera, x, y, width, height), pivotDepth(camera)));
  const towards = (p) => add(anchor, scale(sub(p, anchor), factor));
  return { ...camera, position: towards(camera.position), pivot: towards(camera.pivot) };
}

// By steps (right, up, back) in camera axes.
function flown(camera, steps) {
  const a = axes(camera.rotation), move = add(add(scale(a[0], steps[0]), scale(a[1], steps[1])), scale(a[2], steps[2]));
  return { ...camera, position: add(camera.position, move), pivot: add(camera.pivot, move) };
}

function toFragment(camera) {
  const distance = norm(sub(camera.position, camera.pivot));
  return "#v=" + [...camera.position, ...camera.rotation, distance, camera.fov].map((x) => Number(x.toPrecision(7))).join(",");
}

function fromFragment(text) {
  const match = /^#v=([-+.\de,]+)$/.exec(text || ""), n = match ? match[1].split(",").map(Number) : [];
  if (n.length !== 9 || !n.every(Number.isFinite) || norm(n.slice(3, 7)) < 1e-6 || !(n[7] > 0) || !(n[8] > 0 && n[8] < 3)) return null;
  const rotation = unit(n.slice(3, 7)), position = n.slice(0, 3);
  return { position, rotation, pivot: sub(position, scale(rotate(rotation, [0, 0, 1]), n[7])), fov: n[8] };
}

// ------------------------------------------------------------------ paths
// Keyframes {camera, seconds}: `seconds` until the next one. Positions: Catmull-Rom, centripetal (Barry and Goldman 1988; Yuksel,
// Schaefer and Keyser 2011); rotations: squad (Shoemake 1987).
function pathSeconds(keys, loop) {
  return keys.reduce((sum, key, i) => sum + (loop || i + 1 < keys.length ? key.seconds : 0), 0);
}

function slerp(a, b, t) {
  let c = dot(a, b);
  const to = c < 0 ? scale(b, -1) : b;
  c = Math.min(Math.abs(c), 1);
  const angle = Math.acos(c);
  if (angle < 1e-6) return unit(add(scale(a, 1 - t), scale(to, t)));
  return unit(add(scale(a, Math.sin((1 - t) * angle) / Math.sin(angle)), scale(to, Math.sin(t * angle) / Math.sin(angle))));
}

function logarithm(q) {
  const s = norm(q.slice(1));
  return s < 1e-12 ? [0, 0, 0] : scale(q.slice(1), Math.atan2(s, q[0]) / s);
}

function squad(p, q, r, s, t) {  // between q and r, p and s their neighbours
  const near = (a, b) => (dot(a, b) < 0 ? scale(b, -1) : b);
  const r1 = near(q, r), inner = (before, at, after) => {
    const back = conjugate(at);
    const v = scale(add(logarithm(multiply(back, near(at, after))), logarithm(multiply(back, near(at, before)))), -0.25);
    const angle = norm(v);
    return multiply(at, angle < 1e-12 ? [1, 0, 0, 0] : [Math.cos(angle), ...scale(v, Math.sin(angle) / angle)]);
  };
  return slerp(slerp(q, r1, t), slerp(inner(p, q, r1), inner(q, r1, s), t), 2 * t * (1 - t));
}

function catmullRom(p, t) {  // between p[1] and p[2]
  const knots = [0];
  for (let i = 1; i < 4; ++i) knots.push(knots[i - 1] + Math.max(Math.sqrt(norm(sub(p[i], p[i - 1]))), 1e-6));
  const x = knots[1] + t * (knots[2] - knots[1]);
  const mix = (a, b, from, to) => add(scale(a, (to - x) / (to - from)), scale(b, (x - from) / (to - from)));
  const a = [0, 1, 2].map((i) => mix(p[i], p[i + 1], knots[i], knots[i + 1]));
  const b = [0, 1].map((i) => mix(a[i], a[i + 1], knots[i], knots[i + 2]));
  return mix(b[0], b[1], knots[1], knots[2]);
}

function pathCamera(keys, seconds, loop) {
  const n = keys.length, last = loop ? n : n - 1;
  if (n === 1) return keys[0].camera;
  let i = 0, left = seconds;
  while (i < last - 1 && left >= keys[i].seconds) left -= keys[i++].seconds;
  const t = clamp(left / Math.max(keys[i].seconds, 1e-9), 0, 1);
  const at = (k) => keys[loop ? (k + n) % n : clamp(k, 0, n - 1)].camera;
  const four = [at(i - 1), at(i), at(i + 1), at(i + 2)];
  const mirror = (end, next) => sub(scale(end, 2), next);  // beyond an end
  const places = four.map((camera) => camera.position);
  if (!loop && i === 0) places[0] = mirror(places[1], places[2]);
  if (!loop && i + 2 >= n) places[3] = mirror(places[2], places[1]);
  const linear = (name) => four[1][name] * (1 - t) + four[2][name] * t;
  const rotation = squad(...four.map((camera) => camera.rotation), t);
  const pivot = add(scale(four[1].pivot, 1 - t), scale(four[2].pivot, t));
  return { position: catmullRom(places, t), rotation, pivot, fov: linear("fov") };
}

// The document that `nerfvol render --cameras` reads; "keyframes" is what this page reads back.
function pathDocument(keys, loop, fps, width, height) {
  const seconds = pathSeconds(keys, loop), count = Math.max(1, Math.round(seconds * fps));
  const frames = Array.from({ length: count }, (_, i) => {
    const camera = pathCamera(keys, keys.length > 1 && count > 1 ? (seconds * i) / (loop ? count : count - 1) : 0, loop);
    const m = matrix(camera), f = focal(camera, width, height);
    return { fl_x: f, fl_y: f, transform_matrix: [m.slice(0, 4), m.slice(4, 8), m.slice(8, 12), m.slice(12)] };
  });
  return { w: width, h: height, cx: width / 2, cy: height / 2, fps, loop, keyframes: keys, frames };
}

if (typeof module !== "undefined")
  module.exports = { project, orbitCamera, matrix, fromMatrix, orbited, panned, zoomed, flown, toFragment, fromFragment, pathCamera, pathDocument, focal, pathSeconds };
