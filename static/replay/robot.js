// The robot in 3D on the clock; poses are fetched in parts of some hundred rows when they are needed.

import { get } from "../site/api.js";
import { t } from "../site/sentences.js";
import { Scene3D } from "../console/scene/scene3d.js";
import { followBench } from "./bench.js";
import { message } from "./data.js";
import { viewer as loaded } from "./viewer.js";

const MATRIX = 16;

export class Robot {
  #scene;
  #clock;
  #address;
  #part = 0; // rows per answer
  #parts = new Map(); // first row -> promise of its numbers
  #size = 0; // numbers per row
  #shown = -1;

  constructor({ scene, clock, address, size }) {
    this.#scene = scene;
    this.#clock = clock;
    this.#address = address;
    this.#size = size;
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#show());
  }

  /** Fetch the first rows and show the robot; throw if it cannot be placed. */
  async begin() {
    const numbers = await this.#fetch(0);
    this.#part = numbers.length / this.#size;
    this.#parts.set(0, Promise.resolve(numbers));
    await this.#show();
  }

  async #fetch(first) {
    const { header, numbers } = await message(`${this.#address}${this.#address.includes("?") ? "&" : "?"}first=${first}`);
    return numbers(header.streams.poses);
  }

  #rows(first) {
    if (!this.#parts.has(first)) {
      const coming = this.#fetch(first);
      coming.catch(() => this.#parts.delete(first));
      this.#parts.set(first, coming);
    }
    return this.#parts.get(first);
  }

  async #show() {
    const { row, rows } = this.#clock;
    if (!this.#part || row === this.#shown) return;
    const first = Math.floor(row / this.#part) * this.#part;
    const next = first + this.#part;
    if (next < rows && row - first > this.#part / 2) this.#rows(next);
    const numbers = await this.#rows(first);
    if (row !== this.#clock.row) return; // the clock has moved on meanwhile
    this.#shown = row;
    const from = (row - first) * this.#size;
    this.#scene.setPoses(numbers.subarray(from, from + this.#size), 1);
  }
}

/** Fill the pane in `root`, or show a sentence instead; `why` is the reason if there is no address. */
export async function robotPane({ root, clock, viewer, geometry: address, poses, bench = "", why = t("page.replay.no_robot", "the episode names no robot") }) {
  const note = root.querySelector("[data-scene-note]");
  if (!address) {
    note.textContent = t("page.replay.no_scene", "No 3D scene: {why}.", { why });
    return;
  }
  try {
    const [geometry] = await Promise.all([get(address), loaded(viewer)]);
    const scene = new Scene3D(root.querySelector("[data-scene]"));
    scene.show(geometry);
    scene.toggle("path"); // a path would show jumps of the clock as motion
    for (const button of root.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => scene.view(button.dataset.view));
    }
    await new Robot({ scene, clock, address: poses, size: geometry.parts.length * MATRIX }).begin();
    if (bench) await followBench(scene, clock, bench);
    note.hidden = true;
  } catch (error) {
    note.textContent = t("page.replay.no_scene", "No 3D scene: {why}.", { why: error.message });
    console.error(error);
  }
}
