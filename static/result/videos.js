// Player for the cameras of one recording, or of several that begin together: play, step, speed, slider, links to moments.

import { cameras } from "../replay/cameras.js";
import { Clock, Shifted } from "../replay/clock.js";
import { syncWithUrl } from "../replay/url_state.js";
import { t } from "../site/sentences.js";

const SECOND = { ArrowLeft: -1, ArrowRight: 1 };

class Player {
  #bar;
  #clock;

  constructor(bar, groups) {
    const recordings = groups.map(({ dataset }) => ({ fps: Number(dataset.fps), frames: Number(dataset.frames) }));
    const fps = Math.max(...recordings.map((one) => one.fps));
    const seconds = Math.max(...recordings.map((one) => one.frames / one.fps));
    this.#bar = bar;
    this.#clock = new Clock({ fps, frames: Math.max(1, Math.round(seconds * fps)) });
    groups.forEach((group, index) => {
      const videos = [...group.querySelectorAll("video[data-camera]")];
      for (const video of videos) video.controls = false;
      const shown = videos.map((video) => ({ camera: video.dataset.camera, address: video.getAttribute("src") }));
      cameras(group, shown, new Shifted(this.#clock, recordings[index]));
    });
    this.#controls();
    bar.hidden = false;
    if ("link" in bar.dataset) syncWithUrl(this.#clock, (wanted) => this.#choose(wanted));
  }

  #part(name) {
    return this.#bar.querySelector(`[data-player-${name}]`);
  }

  #controls() {
    const clock = this.#clock;
    const [play, slider, speed, whole] = ["play", "slider", "speed", "whole"].map((name) => this.#part(name));
    slider.max = String(clock.rows - 1);
    play.addEventListener("click", () => clock.toggle());
    this.#part("back").addEventListener("click", () => clock.step(-1));
    this.#part("forth").addEventListener("click", () => clock.step(1));
    slider.addEventListener("input", () => clock.seekRow(Number(slider.value)));
    speed.addEventListener("change", () => (clock.rate = Number(speed.value)));
    whole.addEventListener("click", () => {
      clock.narrow(null);
      clock.loop = false;
      play.focus();
    });
    const say = () => {
      play.firstChild.textContent = clock.playing ? t("page.player.pause", "Pause ") : t("page.player.play", "Play ");
      whole.hidden = !clock.narrowed;
    };
    const show = () => {
      const words = t("page.player.time", "{at} of {all} s", { at: (clock.row / clock.fps).toFixed(2), all: clock.duration.toFixed(2) });
      slider.value = String(clock.row);
      slider.setAttribute("aria-valuetext", words);
      this.#part("time").textContent = words;
    };
    for (const kind of ["play", "pause", "range"]) clock.addEventListener(kind, say);
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, show);
    say();
    show();
  }

  /** Choose the nearest available speed. */
  #choose(wanted) {
    const speed = this.#part("speed");
    const away = [...speed.options].map(({ value }) => Math.abs(Number(value) - wanted));
    speed.selectedIndex = away.indexOf(Math.min(...away));
    this.#clock.rate = Number(speed.value);
  }

  /** Pause at a moment [s] and scroll the pictures into view. */
  goTo(seconds) {
    this.#clock.pause();
    this.#clock.seekRow(Math.round(seconds * this.#clock.fps));
    this.#bar.scrollIntoView({ block: "nearest" });
  }

  key(event) {
    const clock = this.#clock;
    const moment = document.querySelector(`[data-seek][data-key="${CSS.escape(event.key)}"]`);
    const actions = { " ": () => clock.toggle(), Home: () => clock.seekRow(0), End: () => clock.seekRow(clock.rows - 1) };
    const by = SECOND[event.key];
    if (moment) this.goTo(Number(moment.dataset.seek));
    else if (by && event.shiftKey) clock.seek(clock.time + by);
    else if (by) clock.step(by);
    else if (actions[event.key]) actions[event.key]();
    else return;
    event.preventDefault();
  }
}

let player = null;

/** Make the player for the videos of the page, also if they are loaded later. */
function start() {
  const bar = document.querySelector("[data-player][hidden]");
  const groups = [...document.querySelectorAll(".result-videos[data-frames]")];
  if (bar && groups.length) player = new Player(bar, groups);
}

start();
document.body.addEventListener("htmx:afterSettle", start);
document.addEventListener("click", (event) => {
  const moment = player && event.target.closest("[data-seek]");
  if (!moment || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  player.goTo(Number(moment.dataset.seek));
});
document.addEventListener("keydown", (event) => {
  if (!player || event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event;
  const pressing = event.key === " " && target.closest("button, a, summary");
  if (pressing || target.closest("select, textarea, dialog, input:not([type=range])")) return;
  player.key(event);
});
