// A garment in ONNX Runtime Web (WebAssembly, one thread), as an engine drives it: one call a frame, no Python.
//
//     npm install onnxruntime-web
//     node psi.mjs tshirt.onnx motion.json vertices.bin
//
// motion.json has `rotations` [T][J * 9] and `translation` [T][3]. Beside tshirt.onnx lies tshirt.json, which
// clothjax convert wrote. Vertices [T, V, 3] are written as float32; the median time of a frame is printed.

import { readFileSync, writeFileSync } from "node:fs";
import * as ort from "onnxruntime-web";
import { Garment } from "./garment.mjs";

const [path, motionPath, out] = process.argv.slice(2);
const about = JSON.parse(readFileSync(path.replace(/\.onnx$/, ".json")));
const motion = JSON.parse(readFileSync(motionPath));

ort.env.wasm.numThreads = 1;
const session = await ort.InferenceSession.create(readFileSync(path), { executionProviders: ["wasm"] });
const garment = new Garment(ort, session, about);
await garment.stand(motion.rotations[0], motion.translation[0]);

const count = about.shapes.vertices.reduce((a, b) => a * b, 1);
const vertices = new Float32Array(count * motion.rotations.length);
const milliseconds = [];
for (let t = 0; t < motion.rotations.length; t++) {
  const began = performance.now();
  vertices.set(await garment.step(motion.rotations[t], motion.translation[t]), t * count);
  milliseconds.push(performance.now() - began);
}
writeFileSync(out, vertices);
milliseconds.sort((a, b) => a - b);
console.log(`${milliseconds[milliseconds.length >> 1].toFixed(3)} ms a frame, one thread of WebAssembly`);
