// The page: chooses a cloud, asks the service for its grasps and lists them. Drawing is scene.js's.
import { Scene } from "/viewer/scene.js";

const EXAMPLE_OPTIONS = { viewpoint: [0.38, 0.55, 0.48], up: [0, 0, 1], support_height: 0.05, max_grasps: 10 };
const OWN_OPTIONS = { max_grasps: 10 };
const PREGRASP_DISTANCE = 0.05; // metres; the page asks for it unless the options do

const element = (id) => document.getElementById(id);
const scene = new Scene(element("canvas"));
let cloud = null; // the file that is shown

async function post(address, body, type, accept) {
  const headers = { Accept: accept };
  if (type) headers["Content-Type"] = type;
  if (element("key").value) headers["X-API-Key"] = element("key").value;
  const answer = await fetch(address, { method: "POST", headers, body });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({ title: answer.statusText }));
  throw new Error(`${answer.status}: ${problem.detail ?? problem.title}`);
}

function say(text, bad = false) {
  element("status").textContent = text;
  element("status").classList.toggle("bad", bad);
}

async function attempt(work) {
  try {
    await work();
  } catch (error) {
    say(error.message, true);
  }
}

function readOptions() {
  try {
    return JSON.parse(element("options").value || "{}");
  } catch (error) {
    throw new Error(`The options are no JSON: ${error.message}`);
  }
}

// One option a line.
function write(options) {
  const lines = Object.entries(options).map(([name, value]) => ` ${JSON.stringify(name)}: ${JSON.stringify(value)}`);
  element("options").value = `{\n${lines.join(",\n")}\n}`;
}

function formOf(file) {
  const form = new FormData();
  form.append("cloud", file, file.name);
  return form;
}

// Any file that the service reads; it decodes the file, so that what is shown is what it works with.
async function open(file, options) {
  write(options);
  forget();
  say(`Reading ${file.name} ...`);
  const answer = await post("/viewer/points", formOf(file), null, "*/*");
  const points = new Float32Array(await answer.arrayBuffer());
  cloud = file;
  element("hint").hidden = true;
  element("ask").disabled = false;
  scene.show(points, options);
  await ask();
}

async function ask() {
  const options = readOptions();
  options.pregrasp_distance ??= PREGRASP_DISTANCE;
  const query = Object.entries(options).map(([name, value]) => `${name}=${encodeURIComponent(JSON.stringify(value))}`);
  say("Asking ...");
  const answer = await post(`/grasps?${query.join("&")}`, formOf(cloud), null, "application/json");
  const reply = await answer.json();
  const { points: posted, candidates, collision_free: free } = reply.counts;
  const found = reply.grasps.length ? `${reply.grasps.length} grasps` : `No grasp: ${reply.reason.replaceAll("_", " ")}`;
  say(`${found} · ${posted} points, ${candidates} candidates, ${free} of them free · ${Math.round(reply.timings_ms.total)} ms`);
  scene.showGrasps(reply.grasps.map((grasp) => seen(grasp, options.pregrasp_distance)), reply.gripper.parts);
  list(reply, options.frame_convention ?? "panda");
}

function forget() {
  cloud = null;
  element("ask").disabled = true;
  scene.showGrasps([], []);
  list({ grasps: [], warnings: [] }, "panda");
}

// A grasp as the scene draws it: `pregrasp` is a pose of the TCP in every frame convention.
function seen({ pregrasp, score, width }, distance) {
  const [x, y, z, w] = pregrasp.quaternion_xyzw;
  const travel = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];
  const tcp = pregrasp.position.map((value, axis) => value + distance * travel[axis]);
  return { tcp, quaternion: pregrasp.quaternion_xyzw, score, width };
}

function list(reply, convention) {
  element("warnings").replaceChildren(...reply.warnings.map((text) => made("li", text)));
  const rows = reply.grasps.map((grasp, index) => {
    const row = document.createElement("tr");
    const numbers = [grasp.score.toFixed(3), ...grasp.position.map((value) => value.toFixed(3)), grasp.width.toFixed(3)];
    row.append(...[index + 1, ...numbers].map((text) => made("td", text)));
    row.tabIndex = 0;
    row.addEventListener("click", () => choose(index));
    row.addEventListener("keydown", (event) => event.key === "Enter" && choose(index));
    return row;
  });
  document.querySelector("#grasps tbody").replaceChildren(...rows);
  element("grasps").hidden = element("chosen").hidden = rows.length === 0;

  function choose(index) {
    rows.forEach((row, number) => row.classList.toggle("chosen", number === index));
    document.querySelector("#chosen pre").textContent = JSON.stringify(reply.grasps[index], null, 1);
    document.querySelector("#chosen summary").textContent = `Grasp ${index + 1} as JSON (frame convention ${convention})`;
    scene.choose(index);
  }
  if (rows.length) choose(0);
}

function made(tag, text) {
  const item = document.createElement(tag);
  item.textContent = text;
  return item;
}

async function openExample() {
  const answer = await fetch("/viewer/example.npy");
  await open(new File([await answer.arrayBuffer()], "example.npy"), EXAMPLE_OPTIONS);
}

write(OWN_OPTIONS);
element("example").addEventListener("click", () => attempt(openExample));
element("ask").addEventListener("click", () => attempt(ask));
element("file").addEventListener("change", (event) => {
  const [file] = event.target.files;
  if (file) attempt(() => open(file, readOptions()));
  event.target.value = "";
});
const stage = element("stage");
for (const kind of ["dragover", "dragleave", "drop"]) {
  stage.addEventListener(kind, (event) => {
    event.preventDefault();
    stage.classList.toggle("over", kind === "dragover");
    const file = kind === "drop" ? event.dataTransfer.files[0] : null;
    if (file) attempt(() => open(file, readOptions()));
  });
}
if (!scene.works) say("This browser has no WebGL 2: grasps are listed, but not drawn.", true);
if (new URLSearchParams(location.search).has("example")) attempt(openExample);
