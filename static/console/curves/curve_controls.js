// Which joint is drawn, and whether the curves are paused; if uPlot is not installed, a sentence takes their place.

import { config } from "../live/config.js";
import { Legend } from "./curve_legend.js";
import { Beside } from "./curve_beside.js";
import { Curves } from "./curves.js";
import { jointOptions } from "../manual/joint_names.js";
import { GHOSTS } from "../scene/scene_ghosts.js";
import { MarkLegend } from "./mark_legend.js";
import { Tags } from "../scene/tags.js";
import { formatDuration } from "../live/labels.js";
import { t } from "../../site/sentences.js";
import { loadPlots } from "../../site/uplot.js";

const KEY = `eva-joint-${config.station}`;

/** Make the pane of the curves; resolve to {add(samples), joints(names, units, grippers)}. */
export async function curvePane(store) {
  const note = document.getElementById("curves-note");
  const library = await loadPlots(config.uplot);
  if (!library) {
    note.hidden = false;
    note.textContent = t("page.curves.no_library", "Curves are drawn by uPlot, which is not installed: run make setup and start the lab again.");
    return { add() {}, joints() {} };
  }
  const legend = new Legend(document.getElementById("curves-legend"), (name, shown) => every().forEach((one) => one.reveal(name, shown)));
  const markLegend = new MarkLegend(document.getElementById("curves-marks"));
  const curves = new Curves({ element: document.getElementById("curves"), library, legend, markLegend, names: config.joints });
  const beside = new Beside({ place: document.getElementById("curves-all"), key: `${KEY}-beside`, library, legend });
  const every = () => [curves, ...beside.all];
  beside.joints(config.joints, config.grippers);
  const select = joints(curves, config.joints, config.units, config.grippers);
  document.getElementById("joint-next").addEventListener("click", () => {
    select.selectedIndex = (select.selectedIndex + 1) % Math.max(1, select.options.length);
    select.dispatchEvent(new Event("change"));
  });
  addButton(beside, select);
  pauseButton(every);
  const tags = new Tags(document.querySelector(".curves-pane"), "curves-tags");
  store.on("second", () => {
    tags.show("paused", curves.paused && t("page.curves.paused", "paused {time} ago; data keeps arriving", { time: formatDuration(curves.pausedFor) }));
    tags.show("simulated", curves.simulated && t("page.curves.simulated", "under the bar: executed by the simulated robot"), GHOSTS.simulated.colour);
  });
  return {
    add: (samples) => every().forEach((one) => one.add(samples)),
    joints: (names, units, grippers) => {
      curves.joints(names);
      if (names.join() === [...select.options].map((option) => option.title).join()) return;
      joints(curves, names, units, grippers);
      beside.joints(names, grippers);
    },
  };
}

function joints(curves, names, units, grippers) {
  const select = document.getElementById("joint");
  select.replaceChildren(...jointOptions(names, grippers));
  const wanted = names.indexOf(localStorage.getItem(KEY));
  select.selectedIndex = names.length ? Math.max(0, wanted) : -1;
  const show = () => {
    curves.show(select.selectedIndex);
    document.getElementById("curves-unit").textContent = units[select.selectedIndex] ?? "";
  };
  select.onchange = () => {
    localStorage.setItem(KEY, names[select.selectedIndex]);
    show();
  };
  if (names.length) show();
  return select;
}

/** Let the button add a joint beside those that are drawn, as long as there is room. */
function addButton(beside, select) {
  const button = document.getElementById("curves-add");
  const show = () => button.setAttribute("aria-disabled", String(beside.full));
  button.addEventListener("click", () => {
    beside.add(select.selectedIndex);
    show();
  });
  document.getElementById("curves-all").addEventListener("curves", show);
  show();
}

function pauseButton(every) {
  const button = document.getElementById("curves-pause");
  button.addEventListener("click", () => {
    const paused = !every()[0].paused;
    for (const one of every()) one.pause(paused);
    button.setAttribute("aria-pressed", String(paused));
    button.textContent = paused ? t("page.curves.continue", "Continue") : t("page.curves.pause", "Pause");
  });
}
