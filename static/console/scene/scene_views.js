// The viewpoints of the 3D scene. The viewer's camera uses the frame of three.js, y up.

import { three } from "./scene_shapes.js";

const FIELD = 38; // vertical angle of view [deg]
const ROOM = 1.09; // margin factor around what must be in view
const TOOLS = 46; // height at the top of the pane that its buttons cover [px]
const ROUNDS = 6; // iterations that centre what is seen
const WRIST = { behind: 0.28, aside: 0.4, ahead: 0 }; // distances from a fingertip [m]

function inThree([x, y, z]) {
  return new (three().Vector3)(x, z, -y);
}

const dot = (one, other) => one.reduce((sum, value, axis) => sum + value * other[axis], 0);
const along = (from, way, length) => from.map((value, axis) => value + length * way[axis]);

function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((value) => value / length);
}

/**
 * Return a viewpoint {eye, target} from which all `corners` are seen, looking against `direction`. `wide` and `high` are the
 * tangents of the half angles, horizontal and vertical, in which the corners must lie; `lower` is the tangent of the angle by
 * which their middle lies below the middle of the view.
 */
export function eyeFor(corners, direction, wide, high, lower = 0) {
  const back = unit(direction);
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  let target = corners[0].map((_, axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);
  const look = () => {
    const seen = corners.map((corner) => {
      const off = corner.map((value, axis) => value - target[axis]);
      return { x: dot(off, right), y: dot(off, up), z: dot(off, back) };
    });
    return { seen, distance: Math.max(...seen.map(({ x, y, z }) => z + Math.max(Math.abs(x) / wide, Math.abs(y) / high))) };
  };
  for (let round = 0; round < ROUNDS; round += 1) {
    const { seen, distance } = look();
    const middle = (axis) => {
      const slopes = seen.map((point) => point[axis] / Math.max(1e-3, distance - point.z));
      return ((Math.min(...slopes) + Math.max(...slopes)) / 2) * distance;
    };
    target = along(along(target, right, middle("x")), up, middle("y"));
  }
  const { distance } = look();
  target = along(target, up, lower * distance);
  return { eye: along(target, back, distance), target };
}

export class Views {
  #viewer;
  #corners = [];
  #ahead = [0, 1];
  #standing = false;
  #following = -1;
  #shown = ""; // "" after the user has moved the camera

  constructor(viewer) {
    this.#viewer = viewer;
    viewer.camera.near = 0.01;
    viewer.camera.far = 50;
    viewer.dom_element.addEventListener("pointerdown", () => this.#taken());
    viewer.dom_element.addEventListener("wheel", () => this.#taken(), { passive: true });
  }

  get following() {
    return this.#following;
  }

  /**
   * Set what must be in view by its least and greatest corner, the direction in which the robot works, and whether it stands on
   * the floor, behind its table.
   */
  frame(low, high, ahead, standing) {
    this.#standing = standing;
    this.#corners = [0, 1, 2, 3, 4, 5, 6, 7].map((bits) => low.map((value, axis) => ((bits >> axis) & 1 ? high[axis] : value)));
    this.#ahead = ahead;
  }

  /** Leave the camera to the user; no fingertip is followed any more. */
  #taken() {
    this.#following = -1;
    this.#shown = "";
  }

  /** Show the same view again after the pane has changed its size. */
  again() {
    if (this.#shown && this.#shown !== "wrist") this.show(this.#shown);
  }

  show(name, tips = 0) {
    this.#shown = name;
    if (name === "wrist") {
      this.#following = tips ? (this.#following + 1) % tips : -1;
      return;
    }
    this.#following = -1;
    const [x, y] = this.#ahead;
    const aside = this.#standing ? 1.3 : 0.62; // looks past the table
    const direction = { all: [0.75 * x + aside * y, 0.75 * y - aside * x, 0.62], front: [x, y, 0.12], top: [-0.002 * x, -0.002 * y, 1] }[name];
    this.#look(direction);
  }

  /**
   * Keep the camera close to a fingertip with world matrix `tip` (16 numbers, column by column; its z axis is where it points).
   */
  follow(tip) {
    const [at, way] = [tip.slice(12, 15), tip.slice(8, 11)];
    const upright = Math.abs(way[2]); // 1 if it points straight down: the camera then looks from ahead
    const aside = [this.#ahead[0] * upright, this.#ahead[1] * upright, 0.6 * (1 - upright)];
    const eye = at.map((value, axis) => value - WRIST.behind * way[axis] + WRIST.aside * aside[axis]);
    this.#place(eye, at.map((value, axis) => value + WRIST.ahead * way[axis]));
  }

  #look(direction) {
    const { camera, dom_element: pane } = this.#viewer;
    const high = Math.tan(((FIELD / 2) * Math.PI) / 180);
    const tools = TOOLS / Math.max(3 * TOOLS, pane.clientHeight);
    const { eye, target } = eyeFor(this.#corners, direction, (high / ROOM) * (camera.aspect || 1), (high / ROOM) * (1 - tools), high * tools);
    this.#place(eye, target);
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
