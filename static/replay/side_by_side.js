// Several episodes on one clock: the cameras of each in a column, the curves of one joint in one plot or one below each column.

import { jointOptions } from "../console/manual/joint_names.js";
import { t } from "../site/sentences.js";
import { loadPlots } from "../site/uplot.js";
import { cameras } from "./cameras.js";
import { Clock, Shifted } from "./clock.js";
import { message } from "./data.js";
import { startTimes, differing, clockTimes, sampleAt, commonClock } from "./aligned.js";
import { SharedPlot } from "./shared_plot.js";
import { robotPane } from "./robot.js";
import { Timeline } from "./timeline.js";
import { transport } from "./transport.js";

const config = JSON.parse(document.getElementById("config").textContent);
const given = new URLSearchParams(window.location.search);
const columns = [...document.querySelectorAll("[data-episode]")];
const starts = startTimes(given.get("offset"), config.episodes.length);
const shared = commonClock(config.episodes, starts);
const clock = new Clock(shared);
const timeline = new Timeline(clock);
const element = (id) => document.getElementById(id);

/** Load the page again with another parameter in its address. */
function again(name, value) {
  const address = new URL(window.location.href);
  if (value) address.searchParams.set(name, value);
  else address.searchParams.delete(name);
  window.location.assign(address);
}

const episodes = config.episodes.map((episode, index) => {
  const own = new Shifted(clock, episode, starts.shifts[index]);
  cameras(columns[index], episode.videos, own);
  const row = columns[index].querySelector("[data-row]");
  const say = () => {
    const text = own.resting ? (own.row ? t("page.beside.over", "is over") : t("page.beside.not_begun", "has not begun")) : t("page.replay.row_of", "row {row} of {rows}", { row: own.row, rows: own.rows });
    if (row.textContent !== text) row.textContent = text;
  };
  for (const kind of ["tick", "seek"]) own.addEventListener(kind, say);
  say();
  const field = columns[index].querySelector("[data-offset]");
  field.value = String(starts.offsets[index]);
  field.addEventListener("change", () => {
    const offsets = columns.map((column) => Number(column.querySelector("[data-offset]").value) || 0);
    again("offset", offsets.some(Boolean) ? offsets.join(",") : "");
  });
  return { ...episode, clock: own, shift: starts.shifts[index], number: index + 1 };
});

element("scrub").max = String(clock.rows - 1);
transport(clock);

const scenes = given.get("scene") === "1";
element("with-scenes").setAttribute("aria-pressed", String(scenes));
element("with-scenes").addEventListener("click", () => again("scene", scenes ? "" : "1"));
if (scenes) {
  episodes.forEach((episode, index) => {
    columns[index].querySelector(".beside-scene").hidden = false;
    robotPane({ root: columns[index], viewer: config.viewer, ...episode });
  });
}

const KEY = `eva-beside-joint:${given.getAll("show").join()}`; // key of the joint chosen for these episodes, kept while the tab is open
const SAMPLES = 400; // number of times at which the episodes are compared

async function curves() {
  const library = await loadPlots(config.uplot);
  if (!library) throw new Error(t("page.beside.no_uplot", "uPlot is not installed: run make setup and start the lab again"));
  const read = await Promise.all(episodes.map(async (episode) => ({ ...episode, ...(await message(episode.curves)) })));
  const marks = read.flatMap(({ header, shift, number }) => header.marks.map((mark) => ({ ...mark, time: mark.time + shift, text: `${number}: ${mark.text || mark.kind}` })));
  timeline.fill({ held: [], marks });
  const joints = [...new Set(read.flatMap(({ header }) => header.joints))];
  const grippers = joints.map((name, index) => index).filter((index) => read.some(({ header }) => header.grippers.includes(header.joints.indexOf(joints[index]))));
  const select = element("joint");
  select.replaceChildren(...jointOptions(joints, grippers));
  const time = clockTimes(shared);
  const chosen = joints.indexOf(sessionStorage.getItem(KEY));
  const every = Math.max(1, Math.floor(time.length / SAMPLES));
  select.selectedIndex = chosen >= 0 ? chosen : differing(time.filter((_, row) => row % every === 0), read, joints);
  const plots = new Plots(library, time, read);
  const show = () => {
    const joint = joints[select.selectedIndex];
    const owner = read.find(({ header }) => header.joints.includes(joint));
    element("unit").textContent = owner.header.units[owner.header.joints.indexOf(joint)] ?? "";
    plots.show(joint);
  };
  select.addEventListener("change", () => {
    sessionStorage.setItem(KEY, joints[select.selectedIndex]);
    show();
  });
  element("overlaid").addEventListener("click", () => plots.toggle());
  show();
}

/** One plot of all episodes, or one below each; all with the same range of values. */
class Plots {
  #library;
  #time;
  #read;
  #overlaid = given.get("curves") !== "beside";
  #plots = [];
  #joint = "";

  constructor(library, time, read) {
    this.#library = library;
    this.#time = time;
    this.#read = read;
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#plots.forEach((plot) => plot.at(clock.time)));
  }

  toggle() {
    this.#overlaid = !this.#overlaid;
    const address = new URL(window.location.href);
    if (this.#overlaid) address.searchParams.delete("curves");
    else address.searchParams.set("curves", "beside");
    window.history.replaceState(null, "", address);
    this.show(this.#joint);
  }

  show(joint) {
    this.#joint = joint;
    for (const plot of this.#plots) plot.destroy();
    element("overlaid").setAttribute("aria-pressed", String(this.#overlaid));
    element("curves").hidden = !this.#overlaid;
    for (const column of columns) column.querySelector("[data-curve]").hidden = this.#overlaid;
    const lines = this.#read.map((episode) => ({ number: episode.number, ...sampleAt(this.#time, episode, joint) }));
    const places = this.#overlaid ? [[element("curves"), lines]] : lines.map((line, index) => [columns[index].querySelector("[data-curve]"), [line]]);
    const seek = (time) => clock.seekRow(Math.floor(time * clock.fps));
    this.#plots = places.map(([place, own]) => new SharedPlot({ element: place, library: this.#library, time: this.#time, lines: own, all: lines, seek }));
    for (const plot of this.#plots) plot.at(clock.time);
  }
}

curves().then(
  () => (element("curves-note").hidden = true),
  (error) => {
    element("curves-note").textContent = t("page.replay.no_curves", "No curves: {why}.", { why: error.message });
    console.error(error);
  },
);
