// One frame of the live socket onto the page: the newest of every stream, pictures and numbers of one moment.

const CURVES = { measured: "state", raw: "raw", planned: "smoothed", executed: "executed" }; // of stream "recent", as drawn
const SOFTWARE_FRAME_MS = 60; // a browser without a graphics card shares the processor with the robot's programs

const nothing = { poses() {}, bench() {}, chunk() {}, aim() {}, add() {}, joints() {}, software: false };

/** The panes that need time to load; until then their data goes nowhere. */
export const panes = { scene: nothing, curves: nothing };

/** Draw it; resolves when it is on the screen, which earns the next one. */
export async function drawFrame(frame, store, cameras) {
  const { streams } = frame.header;
  const showPictures = await cameras.prepare(frame);
  await onScreen();
  showPictures();
  if (streams.state) store.setSnapshot(streams.state.json);
  if (streams.joints) store.setJoints({ ...streams.joints.json, ...arrays(frame, streams.joints) });
  if (streams.recent) panes.curves.add(samples(frame, streams.recent));
  if (streams.chunk) panes.scene.chunk({ ...streams.chunk.json, ...arrays(frame, streams.chunk) });
  if (streams.poses) panes.scene.poses(frame.numbers(streams.poses), streams.poses.shape.length > 2 ? streams.poses.shape[0] : 1);
  if (panes.scene.software) await pace();
}

function onScreen() {
  return new Promise((resolve) => requestAnimationFrame(resolve));
}

let due = 0; // when the next frame may be asked for, on this page's clock [ms]

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
