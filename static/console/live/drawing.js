// Draws one frame of the live socket: the newest message of every stream, so that pictures and numbers are from one moment.

// Curves of the stream "recent" -> names under which they are drawn.
const CURVES = { measured: "state", raw: "raw", planned: "smoothed", executed: "executed" };
// A browser without a graphics card shares the processor with the robot's programs, and 3D is most of its work: shortest times [ms]
// between frames, and between frames with 3D. Pictures do not wait for 3D.
const SOFTWARE_FRAME_MS = 30;
const SOFTWARE_SCENE_MS = 120;

const nothing = { poses() {}, bench() {}, chunk() {}, aim() {}, add() {}, joints() {}, software: false };

/** The panes that take time to load; until they have loaded, their data is dropped. */
export const panes = { scene: nothing, curves: nothing };

/** Draw a frame; resolve when it is on the screen, and the server may send the next one. */
export async function drawFrame(frame, store, cameras) {
  const { streams } = frame.header;
  const showPictures = await cameras.prepare(frame);
  await onScreen();
  showPictures();
  if (streams.state) store.setSnapshot(streams.state.json);
  if (streams.joints) store.setJoints({ ...streams.joints.json, ...arrays(frame, streams.joints) });
  if (streams.recent) panes.curves.add(samples(frame, streams.recent));
  if (streams.chunk) panes.scene.chunk({ ...streams.chunk.json, ...arrays(frame, streams.chunk) });
  if (streams.poses) poses = [frame.numbers(streams.poses), streams.poses.shape.length > 2 ? streams.poses.shape[0] : 1];
  drawPoses();
  if (panes.scene.software) await pace();
}

let poses = null; // the newest that are not drawn yet
let posesDue = 0; // earliest time at which they are drawn, on this page's clock [ms]

function drawPoses() {
  const now = performance.now();
  if (!poses || (panes.scene.software && now < posesDue)) return;
  panes.scene.poses(...poses);
  poses = null;
  posesDue = now + SOFTWARE_SCENE_MS;
}

function onScreen() {
  return new Promise((resolve) => requestAnimationFrame(resolve));
}

let due = 0; // earliest time at which to ask for the next frame, on this page's clock [ms]

function pace() {
  const now = performance.now();
  due = Math.max(now, due + SOFTWARE_FRAME_MS);
  return new Promise((resolve) => setTimeout(resolve, due - now));
}

function arrays(frame, { arrays: places = {} }) {
  return Object.fromEntries(Object.entries(places).map(([name, place]) => [name, frame.numbers(place)]));
}

function samples(frame, stream) {
  const found = Object.entries(arrays(frame, stream)).map(([name, numbers]) => [CURVES[name], numbers]);
  return { ...stream.json, curves: Object.fromEntries(found) };
}
