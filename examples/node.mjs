// Grasps for a cloud, with Node's own fetch (Node 20 or later); the body is a form with the .npy file.
//
//   node examples/node.mjs [URL [CLOUD.npy]]
import { readFile } from "node:fs/promises";

const [url = "http://127.0.0.1:8000", cloud = new URL("clutter.npy", import.meta.url)] = process.argv.slice(2);

const options = { viewpoint: [0.38, 0.55, 0.48], up: [0, 0, 1], support_height: 0.05, max_grasps: 5 };
const form = new FormData();
form.append("cloud", new Blob([await readFile(cloud)]), "cloud.npy");
form.append("options", JSON.stringify(options));

const request = { method: "POST", body: form, signal: AbortSignal.timeout(60_000) };
const answer = await fetch(`${url}/grasps`, request).catch((error) => {
  console.error(`${url}: ${error.cause?.message ?? error.message}`);
  process.exit(1);
});
const document = await answer.json();
if (!answer.ok) {
  console.error(`${answer.status}: ${document.detail}`);
  process.exitCode = 1;
} else if (document.grasps.length === 0) {
  console.log(`no grasps: ${document.reason}`);
} else {
  for (const { score, position, width } of document.grasps) {
    const tcp = position.map((metres) => metres.toFixed(3)).join(" ");
    console.log(`${score.toFixed(2)}  TCP at ${tcp}  opening ${width.toFixed(3)} m`);
  }
}
