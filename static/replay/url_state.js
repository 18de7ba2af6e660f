// The state of the playback in the page's address: time, part that is played, speed. It survives a reload and can be shared.

const WAIT_MS = 250; // time between two changes of the address [ms]; browsers limit their number
const OWN = ["t", "from", "to", "loop", "speed"];

/**
 * Parse the search part of an address into {row, range: {from, to} or null, loop, speed}; row and speed are null if they are
 * missing.
 */
export function parseSearch(search, fps) {
  const given = new URLSearchParams(search);
  const number = (name) => (given.get(name) === null || given.get(name).trim() === "" || !Number.isFinite(Number(given.get(name))) ? null : Number(given.get(name)));
  const [time, from, to] = [number("t"), number("from"), number("to")];
  const row = (seconds) => Math.max(0, Math.round(seconds * fps));
  const range = from !== null && to !== null && row(to) > row(from) ? { from: row(from), to: row(to) } : null;
  return { row: time === null ? null : row(time), range, loop: given.get("loop") === "1", speed: number("speed") };
}

/** Return the search part with `state` and all other parameters of `search`. */
export function toSearch(search, { row, range, loop, speed }, fps) {
  const said = new URLSearchParams(search);
  for (const name of OWN) said.delete(name);
  const seconds = (of) => String(Number((of / fps).toFixed(4)));
  if (row) said.set("t", seconds(row));
  if (range) {
    said.set("from", seconds(range.from));
    said.set("to", seconds(range.to));
  }
  if (loop) said.set("loop", "1");
  if (speed !== 1) said.set("speed", String(speed));
  return said.size ? `?${said}` : "";
}

/** Apply the state in the address, and keep the address up to date from then on; `choose(speed)` sets the speed. */
export function syncWithUrl(clock, choose) {
  const { row, range, loop, speed } = parseSearch(window.location.search, clock.fps);
  if (speed !== null) choose(speed);
  if (range) clock.narrow(range);
  if (loop) clock.loop = true;
  if (row !== null) clock.seekRow(row);
  let waiting = null;
  const say = () => {
    waiting = null;
    const state = { row: clock.row, range: clock.narrowed ? clock.range : null, loop: clock.loop, speed: clock.rate };
    window.history.replaceState(null, "", window.location.pathname + toSearch(window.location.search, state, clock.fps) + window.location.hash);
  };
  clock.addEventListener("change", () => (waiting ??= setTimeout(say, WAIT_MS)));
}
