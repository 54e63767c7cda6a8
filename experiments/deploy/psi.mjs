// A garment in ONNX Runtime Web (WebAssembly, one thread), as an engine drives it: one call a frame, no Python.
//
//     npm install onnxruntime-web
//     node psi.mjs tshirt.onnx motion.json vertices.bin
//
// motion.json has `rotations` [T][J * 9] and `translation` [T][3]. Beside tshirt.onnx lies tshirt.json, which
// experiments.convert wrote. Vertices [T, V, 3] are written as float32; the median time of a frame is printed.

import { readFileSync, writeFileSync } from "node:fs";
import * as ort from "onnxruntime-web";

const [path, motionPath, out] = process.argv.slice(2);
const about = JSON.parse(readFileSync(path.replace(/\.onnx$/, ".json")));
const motion = JSON.parse(readFileSync(motionPath));
const shapes = about.shapes;
const tensor = (name, values) => new ort.Tensor("float32", Float32Array.from(values), shapes[name]);

ort.env.wasm.numThreads = 1;
const session = await ort.InferenceSession.create(readFileSync(path), { executionProviders: ["wasm"] });

async function step(state, t) {
  const pose = {
    rotations: tensor("rotations", motion.rotations[t]),
    translation: tensor("translation", motion.translation[t]),
  };
  return session.run({ ...state, ...pose });
}

// the character has been standing in the first pose: about.first_state
const size = shapes.history.reduce((a, b) => a * b, 1);
const first = tensor("latent", about.first_latent);
const probe = await step({ latent: first, history: tensor("history", new Float32Array(size)) }, 0);
const newest = probe.next_history.data.slice(0, size / 2);
let state = { latent: first, history: tensor("history", [...newest, ...newest]) };

const count = about.shapes.vertices.reduce((a, b) => a * b, 1);
const vertices = new Float32Array(count * motion.rotations.length);
const milliseconds = [];
for (let t = 0; t < motion.rotations.length; t++) {
  const began = performance.now();
  const result = await step(state, t);
  milliseconds.push(performance.now() - began);
  state = { latent: result.next_latent, history: result.next_history };
  vertices.set(result.vertices.data, t * count);
}
writeFileSync(out, vertices);
milliseconds.sort((a, b) => a - b);
console.log(`${milliseconds[milliseconds.length >> 1].toFixed(3)} ms a frame, one thread of WebAssembly`);
