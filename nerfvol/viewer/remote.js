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
        const { version, sentence } = await (await ask("/state", { version: remote.version })).json();
        remote.say(sentence);
        if (version > remote.version) await replace(await remote.model());
      } catch {
        remote.say("The server does not answer");
        await new Promise((done) => setTimeout(done, 3000));
      }
    }
  },
  say(sentence) {
    const line = document.getElementById("live");
    if (line) line.textContent = sentence;
  },
  // Builds what belongs to it in `place`; look(camera), path() and say(sentence) are the page's.
  async build(place, page) {
    place.hidden = false;
    place.innerHTML = `<p id="live" class="note"></p>
      <details id="views" hidden><summary>Photographs</summary><div class="row"><button type="button" id="earlier" aria-label="Photograph before">←</button>
      <select id="photos" aria-label="Photograph"></select><button type="button" id="later" aria-label="Next photograph">→</button></div>
      <p id="score" class="note" role="status"></p><img id="photo" alt="Photograph" hidden><img id="error" alt="Error: black none, white a quarter or more" hidden></details>
      <details><summary>Video</summary><div class="row"><button type="button" id="film">Make video of the path</button></div>
      <progress id="progress" hidden></progress><p id="filmed" class="note" role="status"></p></details>`;
    const find = (id) => place.querySelector("#" + id), cameras = await (await ask("/cameras")).json();
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
    find("photos").onchange = jump;
    find("earlier").onclick = () => step(-1);
    find("later").onclick = () => step(1);
    find("film").onclick = () => film(find, page).catch((error) => { find("filmed").textContent = error.message; });
  },
};

async function film(find, page) {
  const path = page.path();
  if (!path.frames.length || !path.keyframes.length) throw new ModelError("Add views to the camera path first");
  let state = await (await ask("/render", { fps: path.fps }, { method: "POST", body: JSON.stringify(path) })).json();
  const bar = find("progress");
  bar.hidden = false;
  while (!state.finished) {
    await new Promise((done) => setTimeout(done, 300));
    state = await (await ask("/progress")).json();
    Object.assign(bar, { max: state.of, value: state.done });
    find("filmed").textContent = `${state.done} of ${state.of} pictures`;
  }
  bar.hidden = true;
  if (state.fault) throw new ModelError(`The video could not be made: ${state.fault}`);
  const link = Object.assign(document.createElement("a"), { href: here("/video"), download: "path.mp4", textContent: "Save path.mp4" });
  find("filmed").replaceChildren(link);
}
