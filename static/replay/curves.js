// The pane of the curves: which joint, what its values are at the clock, and the plot.

import { joint, message } from "./data.js";
import { LEGEND, Plot } from "./plot.js";

const KEY = "eva-replay-joint";

/** Fill the pane, or put a sentence in its place; resolves to {held, marks}, empty where nothing is known. */
export async function curvePane({ clock, address, uplot }) {
  const note = document.getElementById("curves-note");
  try {
    const { header, numbers } = await message(address);
    const episode = read(header, numbers);
    const library = (await import(uplot).catch(() => null))?.default;
    if (library) new Pane(clock, episode, library);
    note.hidden = Boolean(library);
    note.textContent = library ? "" : "Curves are drawn by uPlot, which is not installed: run npm install in the project's folder.";
    return { held: header.held, marks: header.marks };
  } catch (error) {
    note.textContent = `No curves: ${error.message}.`;
    console.error(error);
    return { held: [], marks: [] };
  }
}

function read(header, numbers) {
  const { ticks, raw } = header.streams;
  const all = (stream) => Object.fromEntries(Object.entries(stream.arrays).map(([name, place]) => [name, numbers(place)]));
  return { header, ticks: all(ticks), raw: all(raw), spaces: raw.json.spaces };
}

class Pane {
  #clock;
  #episode;
  #plot;
  #curves = null;
  #values = {};
  #unit = "";

  constructor(clock, episode, library) {
    this.#clock = clock;
    this.#episode = episode;
    const { held, marks } = episode.header;
    const behind = { held, marks, safety: this.#safety(), chunks: [] };
    this.#plot = new Plot({ element: document.getElementById("curves"), library, behind, seek: (time) => clock.seekRow(Math.floor(time * clock.fps)) });
    this.#legend();
    this.#select();
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
  }

  #safety() {
    const { time, safety } = this.#episode.ticks;
    const found = [];
    safety.forEach((what, index) => what && found.push({ time: time[index], refused: what === 2 }));
    return found;
  }

  #select() {
    const select = document.getElementById("joint");
    const names = this.#episode.header.joints;
    select.replaceChildren(...names.map((name, index) => new Option(name, String(index))));
    const wanted = names.indexOf(localStorage.getItem(KEY));
    select.selectedIndex = Math.max(0, wanted);
    select.addEventListener("change", () => {
      localStorage.setItem(KEY, names[select.selectedIndex]);
      this.#show(select.selectedIndex);
    });
    this.#show(select.selectedIndex);
  }

  #show(index) {
    const { ticks, raw } = this.#episode;
    const length = ticks.time.length;
    const pick = (name) => joint(ticks[name], index, length);
    this.#curves = { time: ticks.time, measured: pick("measured"), executed: pick("executed"), smoothed: pick("smoothed") };
    this.#unit = this.#episode.header.units[index];
    this.#plot.show(this.#curves, chunks(raw.time, joint(raw.values, index, raw.time.length), raw.chunk));
    this.#at();
  }

  #legend() {
    const { safety } = this.#episode.ticks;
    for (const { name, colour } of LEGEND) this.#values[name] = entry(name, colour, "line");
    if (this.#episode.header.held.length) entry("held", "--holding-soft", "patch");
    if (safety.includes(1)) entry("changed by safety", "--holding", "line");
    if (safety.includes(2)) entry("refused", "--faulted", "line");
    if (!this.#episode.spaces.includes("joint")) this.#values.raw.textContent = `raw: the policy speaks in ${this.#episode.spaces.join(", ") || "no"} space`;
  }

  #at() {
    const { time } = this.#clock;
    this.#plot.at(time);
    const tick = last(this.#curves.time, time + 1e-6);
    for (const name of ["measured", "executed", "smoothed"]) {
      const value = tick < 0 ? NaN : this.#curves[name][tick];
      this.#values[name].textContent = `${name} ${Number.isFinite(value) ? `${value.toFixed(3)} ${this.#unit}` : "–"}`;
    }
  }
}

/** Add one entry to the legend; returns where its words stand. */
function entry(name, colour, shape) {
  const part = document.createElement("span");
  part.className = "legend";
  const swatch = document.createElement("i");
  swatch.className = shape;
  swatch.style.background = `var(${colour})`;
  const words = document.createElement("span");
  words.textContent = name;
  part.append(swatch, words);
  document.getElementById("legend").append(part);
  return words;
}

/** Consecutive values of one chunk belong to one line. */
function chunks(times, values, ids) {
  const found = [];
  ids.forEach((id, index) => {
    if (!index || id !== ids[index - 1]) found.push({ times: [], values: [] });
    found.at(-1).times.push(times[index]);
    found.at(-1).values.push(values[index]);
  });
  return found;
}

/** The last index whose time is not after `time`, -1 where there is none. */
function last(times, time) {
  let low = 0;
  let high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}
