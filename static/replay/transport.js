// Buttons and keys of the playback. Space plays here: this page is bound to no station.

const SECOND_KEYS = { ArrowLeft: -1, ArrowRight: 1 };

/** Let buttons and keys move the clock. */
export function transport(clock) {
  const play = document.getElementById("play");
  const speed = document.getElementById("speed");
  const label = play.firstChild;
  play.addEventListener("click", () => clock.toggle());
  document.getElementById("back").addEventListener("click", () => clock.step(-1));
  document.getElementById("forth").addEventListener("click", () => clock.step(1));
  speed.addEventListener("change", () => (clock.rate = Number(speed.value)));
  const say = () => {
    label.textContent = clock.playing ? "Pause " : "Play ";
    play.setAttribute("aria-pressed", String(clock.playing));
  };
  clock.addEventListener("play", say);
  clock.addEventListener("pause", say);
  document.addEventListener("keydown", (event) => key(event, clock, speed));
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
    "[": () => slower(speed, -1),
    "]": () => slower(speed, 1),
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
