// The path of a fingertip: its last points as a line that fades with age.

import { three } from "./scene_shapes.js";

const POINTS = 240;
const STEP_M = 0.003; // smaller steps add no point
const JUMP_M = 0.15;

export class Path {
  #points = [];
  #colour;
  #ground;

  constructor(colour, ground) {
    const THREE = three();
    this.#colour = new THREE.Color(colour);
    this.#ground = new THREE.Color(ground);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(POINTS * 3), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(POINTS * 3), 3));
    geometry.setDrawRange(0, 0);
    this.object = new THREE.Line(geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.object.frustumCulled = false;
  }

  add(x, y, z) {
    const last = this.#points.at(-1);
    const step = last ? Math.hypot(x - last[0], y - last[1], z - last[2]) : Infinity;
    if (step < STEP_M) return;
    if (step > JUMP_M) this.#points = []; // no motion, but a time without data
    this.#points.push([x, y, z]);
    if (this.#points.length > POINTS) this.#points.shift();
    this.#write();
  }

  clear() {
    this.#points = [];
    this.object.geometry.setDrawRange(0, 0);
  }

  #write() {
    const { position, color } = this.object.geometry.attributes;
    const count = this.#points.length;
    const shade = this.#colour.clone();
    this.#points.forEach((point, index) => {
      position.setXYZ(index, ...point);
      shade.copy(this.#ground).lerp(this.#colour, (index + 1) / count);
      color.setXYZ(index, shade.r, shade.g, shade.b);
    });
    position.needsUpdate = true;
    color.needsUpdate = true;
    this.object.geometry.setDrawRange(0, count);
  }
}
