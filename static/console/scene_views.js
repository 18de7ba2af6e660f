// Where the 3D scene is looked at from. The viewer's camera lives in three.js' own frame, y up.

import { three } from "./scene_shapes.js";

const FIELD = 38; // degrees, of the smaller side
const WRIST = { behind: 0.28, aside: 0.4, ahead: 0 }; // m from a fingertip

function inThree([x, y, z]) {
  return new (three().Vector3)(x, z, -y);
}

export class Views {
  #viewer;
  #sphere = { centre: [0, 0.2, 0.15], radius: 0.7 };
  #ahead = [0, 1];
  #following = -1;

  constructor(viewer) {
    this.#viewer = viewer;
    viewer.camera.near = 0.01;
    viewer.camera.far = 50;
    viewer.dom_element.addEventListener("pointerdown", () => this.free());
    viewer.dom_element.addEventListener("wheel", () => this.free(), { passive: true });
  }

  get following() {
    return this.#following;
  }

  /** What has to be in view: a sphere around it, and the side that the robot works towards. */
  frame(centre, radius, ahead) {
    this.#sphere = { centre, radius };
    this.#ahead = ahead;
  }

  /** The person takes the camera: no tip is followed any more. */
  free() {
    this.#following = -1;
  }

  show(name, tips = 0) {
    if (name === "wrist") {
      this.#following = tips ? (this.#following + 1) % tips : -1;
      return;
    }
    this.free();
    const [x, y] = this.#ahead;
    const direction = { all: [0.75 * x + 0.62 * y, 0.75 * y - 0.62 * x, 0.62], front: [x, y, 0.12], top: [-0.002 * x, -0.002 * y, 1] }[name];
    this.#look(direction);
  }

  /** Stay close to a fingertip with world matrix `tip` (16, column by column; z the way it points). */
  follow(tip) {
    const [at, way] = [tip.slice(12, 15), tip.slice(8, 11)];
    const upright = Math.abs(way[2]); // 1 where it points straight down: then look at it from ahead
    const aside = [this.#ahead[0] * upright, this.#ahead[1] * upright, 0.6 * (1 - upright)];
    const eye = at.map((value, axis) => value - WRIST.behind * way[axis] + WRIST.aside * aside[axis]);
    this.#place(eye, at.map((value, axis) => value + WRIST.ahead * way[axis]));
  }

  #look(direction) {
    const { centre, radius } = this.#sphere;
    const { camera } = this.#viewer;
    const half = ((FIELD / 2) * Math.PI) / 180;
    const narrow = Math.min(1, camera.aspect || 1);
    const distance = radius / Math.sin(Math.atan(Math.tan(half) * narrow));
    const length = Math.hypot(...direction);
    this.#place(centre.map((value, axis) => value + (direction[axis] / length) * distance), centre);
  }

  #place(eye, target) {
    const { camera, controls } = this.#viewer;
    camera.fov = FIELD;
    camera.position.copy(inThree(eye));
    controls.target.copy(inThree(target));
    camera.updateProjectionMatrix();
    controls.update();
    this.#viewer.set_dirty();
  }
}
