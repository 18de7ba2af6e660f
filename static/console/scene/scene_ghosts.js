// The robots besides the real one: the commanded pose, a target, a proposed chunk, the robot of a simulation.

import { place, robotParts, SIZE } from "./scene_robot.js";
import { ghostPaint } from "./scene_shapes.js";

/** All are a translucent blue; the more important ghosts are less transparent than one for comparison. */
export const GHOSTS = {
  commanded: { colour: "#3b8cff", opacity: 0.28 },
  aim: { colour: "#3b8cff", opacity: 0.42 },
  chunk: { colour: "#3b8cff", opacity: 0.42 },
  simulated: { colour: "#2f7df0", opacity: 0.7, solid: true },
};

export class Ghosts {
  #geometry;
  #add;
  #drawing;
  #robots = new Map(); // made at first use, because most pages never show most of them
  #there = new Set();
  #hidden = new Set();

  /** `add(path, object)` puts an object into the scene; `drawing` says how robots are drawn in it. */
  constructor(geometry, add, drawing) {
    this.#drawing = drawing;
    this.#geometry = geometry;
    this.#add = add;
  }

  /** Place the parts of ghost `name`, [P * 16] from index `from` on; remove it if `numbers` is null or begins with NaN. */
  pose(name, numbers, from = 0) {
    if (!numbers || numbers.length < from + this.#geometry.parts.length * SIZE || Number.isNaN(numbers[from])) this.#there.delete(name);
    else {
      this.#there.add(name);
      if (!this.#hidden.has(name)) place(this.#robot(name), numbers, from);
    }
    this.#show(name);
  }

  /** Set whether ghost `name` is drawn when it has a pose. */
  allow(name, shown) {
    if (shown) this.#hidden.delete(name);
    else this.#hidden.add(name);
    this.#show(name);
  }

  /** Return whether that ghost is drawn now. */
  visible(name) {
    return this.#there.has(name) && !this.#hidden.has(name);
  }

  /** Return the groups of a ghost. */
  parts(name) {
    return this.#robot(name);
  }

  #show(name) {
    const visible = this.visible(name);
    for (const part of this.#robots.get(name) ?? []) part.visible = visible;
  }

  #robot(name) {
    if (!this.#robots.has(name)) {
      const parts = robotParts(this.#geometry, { ...this.#drawing, paint: () => ghostPaint(GHOSTS[name]) });
      parts.forEach((part, index) => this.#add(`ghost/${name}/${index}`, part));
      this.#robots.set(name, parts);
    }
    return this.#robots.get(name);
  }
}
