// The fingertips: their paths, and the position that the camera follows.

import { Path } from "./scene_path.js";
import { css } from "../live/style.js";
import { three } from "./scene_shapes.js";

export const ARM_COLOURS = ["#4fa3ff", "#f7a04b", "#46d17f", "#c79bff"];

export class Tips {
  #tips; // [{part, pose}] from the server
  #offsets;
  #places;
  #paths = [];

  constructor(tips, add) {
    const THREE = three();
    this.#tips = tips;
    this.#offsets = tips.map(({ pose }) => new THREE.Matrix4().fromArray(pose));
    this.#places = tips.map(() => new THREE.Matrix4());
    tips.forEach((tip, index) => {
      const path = new Path(ARM_COLOURS[index % ARM_COLOURS.length], css("--scene"));
      this.#paths.push(path);
      add(`path/${index}`, path.object);
    });
  }

  get count() {
    return this.#tips.length;
  }

  show(paths) {
    for (const path of this.#paths) path.object.visible = paths;
  }

  /** Move the fingertips with the robot's `parts` (its groups). */
  move(parts) {
    this.#tips.forEach((tip, index) => {
      const world = this.#places[index].multiplyMatrices(parts[tip.part].matrix, this.#offsets[index]).elements;
      this.#paths[index].add(world[12], world[13], world[14]);
    });
  }

  /** Return the matrix of fingertip `index`: 16 numbers, column by column. */
  world(index) {
    return this.#places[index].elements;
  }

  /** Start the paths anew, because another robot acts from now on. */
  forget() {
    for (const path of this.#paths) path.clear();
  }
}
