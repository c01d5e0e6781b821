// What the page does where nerfvol view serves it: the model comes and is replaced, photographs, videos.
"use strict";

const token = new URLSearchParams(location.search).get("token") || "";
const here = (path, query = {}) => path + "?" + new URLSearchParams({ ...query, token });

async function ask(path, query, options = {}) {
  const answer = await fetch(here(path, query), { ...options, headers: { "X-Token": token } });
  if (!answer.ok) throw new ModelError(await answer.text());
  return answer;
}

const remote = {
  version: 0,
  async model() {
    const answer = await ask("/model");
    remote.version = Number(answer.headers.get("X-Version"));
    return new Uint8Array(await answer.arrayBuffer());
  },
  // Waits for a newer model and shows it from where one looks.
  async follow(replace) {
    for (;;) {
      try {
        const { version, sentence, training, paused } = await (await ask("/state", { version: remote.version })).json();
        remote.say(sentence);
        remote.training(training, paused);
        if (version > remote.version) await replace(await remote.model());
      } catch {
        remote.say("The server does not answer");
        await new Promise((done) => setTimeout(done, 3000));
      }
    }
  },
  training(runs, paused) {
    const button = document.getElementById("pause");
    if (!button) return;
    button.hidden = !runs;
    button.textContent = paused ? "Go on training" : "Pause training";
    button.onclick = async () => {
      const state = await (await ask("/pause", { on: paused ? 0 : 1 }, { method: "POST" })).json();
      remote.training(state.training, state.paused);
    };
  },
  say(sentence) {
    const line = document.getElementById("live");
    if (line) line.textContent = sentence;
  },
  // Builds what belongs to it in `place`; look(camera), path() and say(sentence) are the page's.
  async build(place, page) {
    place.hidden = false;
    place.innerHTML = `<p id="live" class="note"></p><div class="row"><button type="button" id="pause" hidden>Pause training</button></div>
      <details id="views" hidden><summary>Photographs</summary><div class="row"><button type="button" id="earlier" aria-label="Photograph before">←</button>
      <select id="photos" aria-label="Photograph"></select><button type="button" id="later" aria-label="Next photograph">→</button></div>
      <div class="row"><label for="shots">Cameras in the scene</label><input id="shots" type="checkbox" checked></div>
      <p id="score" class="note" role="status"></p><img id="photo" alt="Photograph" hidden><img id="error" alt="Error: black none, white a quarter or more" hidden></details>
      <details><summary>Video</summary><div class="row"><button type="button" id="film">Make video of the path</button><button type="button" id="halt" hidden>Stop</button></div>
      <progress id="progress" hidden></progress><p id="filmed" class="note" role="status"></p></details>`;
    const find = (id) => place.querySelector("#" + id), cameras = await (await ask("/cameras")).json();
    const now = await (await ask("/state", { version: 0 })).json();
    remote.training(now.training, now.paused);
    find("views").hidden = !cameras.length;
    find("photos").append(...cameras.map((camera, i) => new Option(camera.name, i)));
    const jump = async () => {
      const index = Number(find("photos").value), camera = cameras[index];
      page.look(fromMatrix(camera.c2w, camera.fov, page.distance(camera.c2w)));
      find("photo").src = here("/photograph", { index });
      find("photo").hidden = false;
      find("score").textContent = "Comparing …";
      try {
        const answer = await ask("/error", { index });
        if (Number(find("photos").value) !== index) return;
        find("score").textContent = `${camera.name}: PSNR ${answer.headers.get("X-PSNR")} dB; photograph, and error below`;
        find("error").src = URL.createObjectURL(await answer.blob());
        find("error").hidden = false;
      } catch (error) { find("score").textContent = error.message; }
    };
    const step = (by) => {
      find("photos").value = (Number(find("photos").value) + by + cameras.length) % cameras.length;
      jump();
    };
    Object.assign(remote, frusta(cameras, page, () => find("views").open && find("shots").checked, (index) => {
      find("photos").value = index;
      jump();
    }));
    find("views").ontoggle = find("shots").onchange = () => remote.moved();
    find("halt").onclick = () => ask("/stop", {}, { method: "POST" });
    find("photos").onchange = jump;
    find("earlier").onclick = () => step(-1);
    find("later").onclick = () => step(1);
    find("film").onclick = () => film(find, page).catch((error) => { find("filmed").textContent = error.message; });
  },
};

// Training cameras over the picture: `moved` draws them, `clicked` chooses the one whose place is nearest to where a click was.
function frusta(cameras, page, wanted, choose) {
  const overlay = document.getElementById("overlay"), NEAR = 14, rows = cameras.map(({ c2w, fov, size }) => {
    const at = [0, 1, 2].map((k) => c2w[k][3]), long = 0.09 * page.distance(c2w), half = Math.tan(fov / 2) * long;
    const [w, h] = size.map((x) => (half * x) / Math.min(...size));
    const corner = (x, y) => [0, 1, 2].map((k) => at[k] + x * c2w[k][0] + y * c2w[k][1] - long * c2w[k][2]);
    return { at, corners: [corner(-w, -h), corner(w, -h), corner(w, h), corner(-w, h)] };
  });
  const moved = () => {
    overlay.hidden = !wanted();
    if (overlay.hidden) return;
    const [width, height] = page.extent(), ratio = Math.min(window.devicePixelRatio || 1, 2), camera = page.camera();
    Object.assign(overlay, { width: width * ratio, height: height * ratio });
    const pen = overlay.getContext("2d");
    pen.scale(ratio, ratio);
    for (const [style, thick] of [["#000a", 3], ["#ffb454", 1.2]]) {
      Object.assign(pen, { strokeStyle: style, lineWidth: thick });
      pen.beginPath();
      for (const { at, corners } of rows) {
        const tip = project(camera, at, width, height), four = corners.map((c) => project(camera, c, width, height));
        if (!tip || four.some((p) => !p)) continue;
        four.forEach((p, i) => [tip, p, four[(i + 1) % 4]].forEach((q, k) => pen[k ? "lineTo" : "moveTo"](...q)));
      }
      pen.stroke();
    }
  };
  const clicked = (x, y) => {
    if (!wanted()) return;
    const apart = rows.map(({ at }) => project(page.camera(), at, ...page.extent())).map((p) => (p ? Math.hypot(p[0] - x, p[1] - y) : Infinity));
    const nearest = apart.indexOf(Math.min(...apart));
    if (apart[nearest] < NEAR) choose(nearest);
  };
  return { moved, clicked };
}

async function film(find, page) {
  const path = page.path();
  if (!path.frames.length || !path.keyframes.length) throw new ModelError("Add views to the camera path first");
  const crop = page.box()?.flat().join(","), query = { fps: path.fps, ...(crop && { crop }) };
  let state = await (await ask("/render", query, { method: "POST", body: JSON.stringify(path) })).json();
  const bar = find("progress");
  bar.hidden = find("halt").hidden = false;
  while (!state.finished) {
    await new Promise((done) => setTimeout(done, 300));
    state = await (await ask("/progress")).json();
    Object.assign(bar, { max: state.of, value: state.done });
    find("filmed").textContent = `${state.done} of ${state.of} pictures`;
  }
  bar.hidden = find("halt").hidden = true;
  if (state.fault) throw new ModelError(`The video could not be made: ${state.fault}`);
  const link = Object.assign(document.createElement("a"), { href: here("/video"), download: "path.mp4", textContent: "Save path.mp4" });
  find("filmed").replaceChildren(link);
}
