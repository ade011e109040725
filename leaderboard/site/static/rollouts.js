"use strict";

// Shows what models predict. Every trajectory is a script that puts itself into `rollouts`: pages that are opened as
// files may load scripts, but not data.

window.rollouts = {};

const choices = JSON.parse(document.getElementById("choices").textContent);
const { task, trajectory, model, context, scale, wire } = document.getElementById("controls").elements;
const [time, play, frameText, facts, largest] = ["time", "play", "frame", "facts", "largest"].map((id) =>
  document.getElementById(id),
);
const viewer = new Viewer(document.getElementById("canvas"), () => draw());
const CONTEXT_COLOUR = [150, 156, 163];
const PAUSE = 70; // milliseconds between frames
let scene = null;
let timer = null;

// -- data ---------------------------------------------------------------------------------------------------

function unpack(text, kind) {
  return new kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

function groups(indices, size) {
  return Array.from({ length: indices.length / size }, (_, i) => [...indices.subarray(i * size, (i + 1) * size)]);
}

function positions(text, step) {
  return Float32Array.from(unpack(text, Int16Array), (value) => value * step);
}

function decode(raw) {
  const truth = positions(raw.truth, raw.step);
  return {
    ...raw,
    truth,
    faces: groups(unpack(raw.faces, Uint16Array), 3),
    collider: {
      ...raw.collider,
      positions: positions(raw.collider.positions, raw.step),
      edges: groups(unpack(raw.collider.edges, Uint16Array), 2),
    },
    predictions: raw.predictions.map((one) => ({ ...one, positions: positions(one.positions, raw.step) })),
    box: box([...truth, ...positions(raw.collider.positions, raw.step)]),
  };
}

// The smallest and largest coordinates of points [x, y, z, x, ...].
function box(points) {
  const [lower, upper] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  points.forEach((value, i) => {
    lower[i % 3] = Math.min(lower[i % 3], value);
    upper[i % 3] = Math.max(upper[i % 3], value);
  });
  return [lower, upper];
}

function load(name) {
  if (name in window.rollouts) return Promise.resolve();
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = `rollouts/${name}.js`;
    script.onload = resolve;
    script.onerror = () => reject(new Error(`${script.src} is missing`));
    document.head.append(script);
  });
}

// -- drawing ------------------------------------------------------------------------------------------------

function chosen() {
  return scene.predictions.find((one) => one.model === model.value && one.context === Number(context.value));
}

// The positions of one frame out of many.
function at(all, nodes, number) {
  return all.subarray(3 * nodes * number, 3 * nodes * (number + 1));
}

// Distance that gets the last colour, in scaled units.
function range(prediction) {
  const same = scene.predictions.filter((one) => one.context === prediction.context);
  return scale.value === "own" ? prediction.largest : Math.max(...same.map((one) => one.largest));
}

// A line, or a grid of squares, somewhat wider than the motion.
function drawFloor() {
  const [lower, upper] = scene.box;
  const [x, y] = [0, 1].map((d) => (lower[d] + upper[d]) / 2);
  const half = 0.7 * Math.max(upper[0] - lower[0], scene.flat ? 0 : upper[1] - lower[1]);
  const z = scene.floor;
  const ends = scene.flat ? [x - half, z, 0, x + half, z, 0] : [];
  for (let i = -4; i <= 4 && !scene.flat; i++) {
    const d = (half * i) / 4;
    ends.push(x - half, y + d, z, x + half, y + d, z, x + d, y - half, z, x + d, y + half, z);
  }
  const lines = Array.from({ length: ends.length / 6 }, (_, i) => [2 * i, 2 * i + 1]);
  viewer.lines(viewer.project(Float32Array.from(ends)), lines, viewer.ink("--floor"), 1);
}

function draw() {
  if (!scene) return;
  const prediction = chosen();
  const number = Number(time.value);
  const frame = scene.frames[number];
  const known = scene.frames.findIndex((one) => one >= prediction.context); // frames that were kept of the context
  const truth = at(scene.truth, scene.nodes, number);
  const seen = frame < prediction.context;
  const shown = seen ? truth : at(prediction.positions, scene.nodes, number - known);
  const distances = Array.from({ length: scene.nodes }, (_, i) =>
    Math.hypot(shown[3 * i] - truth[3 * i], shown[3 * i + 1] - truth[3 * i + 1], shown[3 * i + 2] - truth[3 * i + 2]),
  );
  const most = range(prediction);

  viewer.begin();
  if (scene.floor !== null) drawFloor();
  const points = viewer.project(shown);
  const front = (where) => (scene.closed ? scene.faces.filter((face) => viewer.area(where, face) > 0) : scene.faces);
  viewer.faces(points, front(points), ([a, b, c]) =>
    seen ? CONTEXT_COLOUR : viridis((distances[a] + distances[b] + distances[c]) / (3 * most)),
  );
  if (wire.checked) {
    const lines = viewer.project(truth);
    viewer.lines(lines, front(lines).map(([a, b, c]) => [a, b, c, a]), viewer.ink("--wire"), 0.8, viewer.ink("--halo"));
  }
  const collider = viewer.project(at(scene.collider.positions, scene.collider.nodes, number));
  if (scene.collider.edges.length) viewer.lines(collider, scene.collider.edges, viewer.ink("--collider"), 2);
  else viewer.dots(collider, viewer.ink("--collider"), 6);

  const what = seen ? "context" : "predicted";
  frameText.textContent = `frame ${frame} of ${scene.count - 1}, ${what}`;
  time.setAttribute("aria-valuetext", frameText.textContent);
  viewer.canvas.setAttribute("aria-label", `${model.value} after ${context.value} frames, ${frameText.textContent}`);
  largest.textContent = `${(most * scene.length).toPrecision(2)} ${scene.unit} and more`;
}

function describe() {
  const one = chosen();
  const micro = (value) => (value === null ? "not on record" : `${Number((1e6 * value).toPrecision(3))} × 10⁻⁶`);
  const cut = one.cut ? " Some predicted positions lie outside of what is kept, and are drawn at its border." : "";
  facts.textContent =
    `Error of ${one.model} on this trajectory: ${micro(one.mse)}; over all test trajectories: ` +
    `${micro(one.mean_mse)}.${cut}`;
}

// -- controls -----------------------------------------------------------------------------------------------

function fill(select, options, wanted) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  if (options.some(([value]) => String(value) === String(wanted))) select.value = wanted;
}

function middle(list) {
  return list[list.length >> 1];
}

function offer(wantedModel, wantedContext) {
  const one = choices.find((choice) => choice.task === task.value);
  fill(trajectory, one.trajectories.map(({ name, label }) => [name, label]), middle(one.trajectories).name);
  fill(model, one.models.map((name) => [name, name]), wantedModel);
  fill(context, one.contexts.map((size) => [size, size]), wantedContext ?? middle(one.contexts));
}

async function openTrajectory() {
  pause();
  const name = trajectory.value;
  try {
    await load(name);
  } catch (error) {
    facts.textContent = error.message;
    return;
  }
  if (name !== trajectory.value) return; // another one was chosen meanwhile
  scene = decode(window.rollouts[name]);
  const [lower, upper] = scene.box;
  if (scene.floor !== null) lower[scene.flat ? 1 : 2] = Math.min(lower[scene.flat ? 1 : 2], scene.floor);
  time.max = scene.frames.length - 1;
  time.value = time.max;
  describe();
  viewer.aim(lower, upper, ...scene.look, scene.flat);
}

function pause() {
  clearInterval(timer);
  timer = null;
  play.textContent = "Play";
}

function resume() {
  if (time.value === time.max) time.value = 0;
  play.textContent = "Pause";
  timer = setInterval(() => {
    time.value = Number(time.value) + 1;
    draw();
    if (time.value === time.max) pause();
  }, PAUSE);
}

function fromAddress() {
  const [wantedTask, wantedModel, wantedContext] = decodeURIComponent(location.hash.slice(1)).split("/");
  fill(task, choices.map((one) => [one.task, one.title]), wantedTask);
  offer(wantedModel, wantedContext);
  openTrajectory();
}

task.addEventListener("change", () => {
  offer(model.value);
  openTrajectory();
});
trajectory.addEventListener("change", openTrajectory);
for (const control of [model, context, scale, wire]) {
  control.addEventListener("change", () => {
    if (!scene) return;
    describe();
    draw();
  });
}
time.addEventListener("input", () => {
  pause();
  draw();
});
play.addEventListener("click", () => (timer ? pause() : resume()));
document.getElementById("closer").addEventListener("click", () => viewer.zoom(1.25));
document.getElementById("further").addEventListener("click", () => viewer.zoom(1 / 1.25));
document.getElementById("reset").addEventListener("click", () => viewer.reset());
window.addEventListener("hashchange", fromAddress);
fromAddress();
