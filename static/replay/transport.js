// Buttons and keys of the playback. Space plays and is no e-stop, because this page belongs to no station.

import { t } from "../site/sentences.js";
import { syncWithUrl } from "./url_state.js";

const SECOND_KEYS = { ArrowLeft: -1, ArrowRight: 1 };

/** Let buttons and keys control the clock, and keep its state in the page's address. */
export function transport(clock) {
  const play = document.getElementById("play");
  const speed = document.getElementById("speed");
  const label = play.firstChild;
  play.addEventListener("click", () => clock.toggle());
  document.getElementById("back").addEventListener("click", () => clock.step(-1));
  document.getElementById("forth").addEventListener("click", () => clock.step(1));
  speed.addEventListener("change", () => (clock.rate = Number(speed.value)));
  const say = () => {
    label.textContent = clock.playing ? t("page.player.pause", "Pause ") : t("page.player.play", "Play ");
    play.setAttribute("aria-pressed", String(clock.playing));
  };
  clock.addEventListener("play", say);
  clock.addEventListener("pause", say);
  rangeControls(clock);
  document.addEventListener("keydown", (event) => key(event, clock, speed));
  syncWithUrl(clock, (wanted) => choose(speed, wanted));
}

/** Choose the nearest available speed. */
function choose(speed, wanted) {
  const away = [...speed.options].map(({ value }) => Math.abs(Number(value) - wanted));
  speed.selectedIndex = away.indexOf(Math.min(...away));
  speed.dispatchEvent(new Event("change"));
}

/** Show the part that is played as a band on the time axis, and handle its buttons. */
function rangeControls(clock) {
  const band = document.getElementById("range");
  const loop = document.getElementById("loop");
  const clear = document.getElementById("range-clear");
  document.getElementById("range-in").addEventListener("click", () => begin(clock));
  document.getElementById("range-out").addEventListener("click", () => end(clock));
  clear.addEventListener("click", () => clock.narrow(null));
  loop.addEventListener("click", () => (clock.loop = !clock.loop));
  const show = () => {
    const { from, to } = clock.range;
    band.hidden = !clock.narrowed;
    band.style.left = `${(100 * from) / clock.rows}%`;
    band.style.width = `${(100 * (to - from)) / clock.rows}%`;
    band.title = t("page.replay.range", "Rows {first} to {last}", { first: from, last: to - 1 });
    clear.setAttribute("aria-disabled", String(!clock.narrowed));
    clear.title = clock.narrowed ? t("page.replay.play_all", "Play all rows again, not only {first} to {last}", { first: from, last: to - 1 }) : t("page.replay.all_played", "All rows are played");
    loop.setAttribute("aria-pressed", String(clock.loop));
  };
  clock.addEventListener("range", show);
  show();
}

/** Let the part begin at this row; if its end is not later, it then ends with the episode. */
function begin(clock) {
  const { to } = clock.range;
  clock.narrow({ from: clock.row, to: to > clock.row ? to : clock.rows });
}

function end(clock) {
  const { from } = clock.range;
  clock.narrow({ from: from <= clock.row ? from : 0, to: clock.row + 1 });
}

function key(event, clock, speed) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target.closest("select, textarea, input:not([type=range])");
  const pressing = event.key === " " && event.target.closest("button, a, summary");
  if (typing || pressing) return;
  const actions = {
    " ": () => clock.toggle(),
    Home: () => clock.seekRow(0),
    End: () => clock.seekRow(clock.rows - 1),
    "-": () => slower(speed, -1),
    "+": () => slower(speed, 1),
    "=": () => slower(speed, 1),
    i: () => begin(clock),
    o: () => end(clock),
    l: () => (clock.loop = !clock.loop),
    r: () => clock.narrow(null),
  };
  const direction = SECOND_KEYS[event.key];
  if (direction && event.shiftKey) clock.seek(clock.time + direction);
  else if (direction) clock.step(direction);
  else if (actions[event.key]) actions[event.key]();
  else return;
  event.preventDefault();
}

function slower(speed, by) {
  const next = Math.min(Math.max(0, speed.selectedIndex + by), speed.options.length - 1);
  if (next === speed.selectedIndex) return;
  speed.selectedIndex = next;
  speed.dispatchEvent(new Event("change"));
}
