// Garments of clothjax on a body, in a browser: ONNX Runtime Web moves the cloth, three.js skins the body and draws both.
//
// In the address: garment, motion; provider (wasm, or webgpu where there is one); camera, as eye, target and the height
// seen at the target, all in m; frames, after which it stops; fast, to draw as often as the screen does.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import * as ort from "onnxruntime-web";
import { Garment } from "../deploy/garment.mjs";

const asked = new URLSearchParams(location.search);
const element = (id) => document.getElementById(id);
const fetched = async (path, kind) => {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status} ${answer.statusText}`);
  return answer[kind]();
};

const fail = (problem) => (element("time").value = problem?.message ?? String(problem));
addEventListener("error", (event) => fail(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => fail(event.reason));

ort.env.wasm.numThreads = 1;
const about = await fetched("about.json", "json");

// --- the stage ------------------------------------------------------------------------------------------------------

const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const colour = (rgb) => new THREE.Color().setRGB(...rgb, THREE.SRGBColorSpace);
scene.background = colour([0.97, 0.975, 0.98]);
scene.add(new THREE.HemisphereLight(0xffffff, 0xb8b0a8, 1.8));
const sun = new THREE.DirectionalLight(0xffffff, 2.0);
sun.position.set(0.45, 0.8, 0.55);
scene.add(sun, new THREE.GridHelper(20, 40, 0xc0c0c0, 0xdddddd));
const camera = new THREE.PerspectiveCamera(30, 1, 0.05, 60);
const controls = new OrbitControls(camera, renderer.domElement);
camera.position.set(2.2, 1.5, 3.4);
controls.target.set(0, 0.95, 0);
if (asked.has("camera")) {
  const [x, y, z, u, v, w, height] = asked.get("camera").split(",").map(Number);
  camera.position.set(x, y, z);
  controls.target.set(u, v, w);
  camera.fov = (360 / Math.PI) * Math.atan(height / 2 / camera.position.distanceTo(controls.target));
}
controls.update();

function fit() {
  renderer.setPixelRatio(devicePixelRatio);
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}
addEventListener("resize", fit);
fit();

// --- the body -------------------------------------------------------------------------------------------------------

const bytes = await fetched("body.bin", "arrayBuffer");
const part = (Kind, name) => new Kind(bytes, ...about.body[name]);
const rest = about.joints.map((place) => new THREE.Vector3(...place));
const bones = rest.map((place, j) => {
  const bone = new THREE.Bone();
  bone.position.copy(place);
  if (about.parents[j] >= 0) bone.position.sub(rest[about.parents[j]]);
  return bone;
});
about.parents.forEach((parent, j) => parent >= 0 && bones[parent].add(bones[j]));
const shape = new THREE.BufferGeometry();
shape.setAttribute("position", new THREE.BufferAttribute(part(Float32Array, "vertices"), 3));
shape.setAttribute("skinIndex", new THREE.BufferAttribute(part(Uint16Array, "bones"), 4));
shape.setAttribute("skinWeight", new THREE.BufferAttribute(part(Float32Array, "weights"), 4));
shape.setIndex(new THREE.BufferAttribute(part(Uint32Array, "faces"), 1));
shape.computeVertexNormals();
const body = new THREE.SkinnedMesh(shape, new THREE.MeshLambertMaterial({ color: colour(about.skin) }));
body.frustumCulled = false;
body.add(bones[0]);
body.updateMatrixWorld(true);
body.bind(new THREE.Skeleton(bones));
scene.add(body);

const turn = new THREE.Matrix4();
function pose(rotations, translation) {
  bones.forEach((bone, j) => {
    const [a, b, c, d, e, f, g, h, i] = rotations.subarray(9 * j, 9 * j + 9);
    bone.quaternion.setFromRotationMatrix(turn.set(a, b, c, 0, d, e, f, 0, g, h, i, 0, 0, 0, 0, 1));
  });
  bones[0].position.set(...translation).add(rest[0]);
}

// --- the garment ----------------------------------------------------------------------------------------------------

const cloth = new THREE.Mesh(
  new THREE.BufferGeometry(),
  new THREE.MeshLambertMaterial({ color: colour(about.cloth), side: THREE.DoubleSide }),
);
cloth.frustumCulled = false;
scene.add(cloth);
const webgpu = asked.get("provider") === "webgpu" && (await navigator.gpu?.requestAdapter());
const providers = webgpu ? ["webgpu", "wasm"] : ["wasm"];
let garment, clip, frame, milliseconds;

async function wear(name) {
  const told = await fetched(`garments/${name}.json`, "json");
  const model = new Uint8Array(await fetched(`garments/${name}.onnx`, "arrayBuffer"));
  const session = await ort.InferenceSession.create(model, { executionProviders: providers });
  await garment?.session.release();
  garment = new Garment(ort, session, told);
  cloth.geometry.dispose();
  cloth.geometry = new THREE.BufferGeometry();
  const count = told.shapes.vertices.reduce((a, b) => a * b, 1);
  cloth.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(count), 3));
  cloth.geometry.setIndex(told.faces.flat());
  await begin();
}

async function play(name) {
  clip = new Float32Array(await fetched(`motions/${name}.bin`, "arrayBuffer"));
  await begin();
}

const row = 9 * about.joints.length + 3;
const at = (t) => [clip.subarray(row * t, row * t + row - 3), clip.subarray(row * t + row - 3, row * t + row)];

async function begin() {
  if (!garment || !clip) return;
  await garment.stand(...at(0));
  frame = 0;
  milliseconds = [];
}

async function next() {
  if (frame === clip.length / row) await begin();
  const now = at(frame);
  const began = performance.now();
  const vertices = await garment.step(...now);
  milliseconds.push(performance.now() - began);
  pose(...now);
  cloth.geometry.attributes.position.array.set(vertices);
  cloth.geometry.attributes.position.needsUpdate = true;
  cloth.geometry.computeVertexNormals();
  frame += 1;
}

// --- running --------------------------------------------------------------------------------------------------------

const wanted = []; // changes of garment and motion, for between two frames
for (const [id, names, change] of [
  ["garment", about.garments, wear],
  ["motion", about.motions, play],
]) {
  element(id).append(...names.map((name) => new Option(name, name)));
  element(id).value = names.includes(asked.get(id)) ? asked.get(id) : names[0];
  element(id).onchange = () => wanted.push(() => change(element(id).value));
  await change(element(id).value);
}
element("wireframe").onchange = () => (cloth.material.wireframe = element("wireframe").checked);

let steps = 0;
let due = performance.now();
const last = Number(asked.get("frames") ?? Infinity);
const still = () => element("pause").checked || steps >= last;

function tell() {
  const sorted = milliseconds.slice(-120).sort((a, b) => a - b);
  const vertices = cloth.geometry.attributes.position.array;
  window.clothjax = { steps, milliseconds: sorted[sorted.length >> 1], finite: vertices.every(Number.isFinite) };
  element("time").value = `${window.clothjax.milliseconds.toFixed(2)} ms a frame of garment, ${providers[0]}`;
}

// The camera goes along with the character.
function follow() {
  const { x, z } = bones[0].position;
  const step = new THREE.Vector3(x, controls.target.y, z).sub(controls.target).multiplyScalar(0.2);
  camera.position.add(step);
  controls.target.add(step);
}

async function advance(now) {
  const changed = wanted.length > 0;
  while (wanted.length) await wanted.shift()();
  if (changed || (!still() && (asked.has("fast") || now >= due))) {
    await next();
    steps += 1;
    due = Math.max(due + 1000 / about.fps, now - 100);
    tell();
    if (!asked.has("camera")) follow();
  }
}

async function draw(now) {
  await advance(now).catch(fail);
  controls.update();
  renderer.render(scene, camera);
  requestAnimationFrame(draw);
}
requestAnimationFrame(draw);
