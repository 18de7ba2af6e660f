// What an address says of the playback: the time, the part that is played, the speed. Reload and share work.

const WAIT_MS = 250; // between two changes of the address: browsers allow only so many
const OWN = ["t", "from", "to", "loop", "speed"];

/** The state in the search part of an address: {row, range: {from, to} or null, loop, speed}; null for what it does not say. */
export function parseSearch(search, fps) {
  const given = new URLSearchParams(search);
  const number = (name) => (given.get(name) === null || given.get(name).trim() === "" || !Number.isFinite(Number(given.get(name))) ? null : Number(given.get(name)));
  const [time, from, to] = [number("t"), number("from"), number("to")];
  const row = (seconds) => Math.max(0, Math.round(seconds * fps));
  const range = from !== null && to !== null && row(to) > row(from) ? { from: row(from), to: row(to) } : null;
  return { row: time === null ? null : row(time), range, loop: given.get("loop") === "1", speed: number("speed") };
}

/** The search part that says `state` and all else that `search` says. */
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

/** Do what the address says, and let it say from then on what is done. */
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
