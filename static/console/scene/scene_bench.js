// The surroundings of the robot: table, mounts and ground, and on a simulated bench discs and blocks. Metres, z up.

import { css } from "../live/style.js";
import { material, shape, three } from "./scene_shapes.js";

const LEG = 0.045; // edge of a leg [m]
const UNDER = 0.04; // depth of the ground below the table's surface if there is no floor [m]
const SIDE = 5; // side of the ground [m]

function box(size, colour, at) {
  const THREE = three();
  const mesh = new THREE.Mesh(shape("box", size), material(colour));
  mesh.position.set(...at);
  return mesh;
}

/** Return a table with its surface at z = 0; `legs` is the height of the surface above the floor, if the table has legs. */
export function table({ centre: [x, y], size: [width, depth], thickness, colour, legs }) {
  const group = new (three().Group)();
  group.add(box([width, depth, thickness], colour, [x, y, -thickness / 2 - 0.001]));
  if (!legs) return group;
  const dark = colour.map((part, index) => (index < 3 ? part * 0.7 : part));
  const length = legs - thickness;
  for (const right of [-1, 1]) {
    for (const far of [-1, 1]) {
      const at = [x + (right * (width - 2 * LEG)) / 2, y + (far * (depth - 2 * LEG)) / 2, -thickness - length / 2];
      group.add(box([LEG, LEG, length], dark, at));
    }
  }
  return group;
}

/** Return a column with a foot, up to the base that stands on it. */
export function mount({ at: [x, y], from, to, radius, colour }) {
  const THREE = three();
  const group = new THREE.Group();
  const part = (size, z) => {
    const mesh = new THREE.Mesh(shape("cylinder", size), material(colour));
    mesh.position.set(x, y, z);
    group.add(mesh);
  };
  part([radius, to - from], (from + to) / 2);
  part([1.7 * radius, 0.012], from + 0.006);
  return group;
}

/** Return a grid, at the height of the floor if there is one. */
export function ground(floor) {
  const grid = new (three().GridHelper)(SIDE, SIDE * 10, css("--scene-grid"), css("--scene-grid"));
  grid.rotateX(Math.PI / 2);
  grid.position.z = floor ?? -UNDER;
  return grid;
}

/** Return a flat disc centred on its own origin, standing on z = 0. */
export function disc({ radius, height, colour, rim }) {
  const THREE = three();
  const group = new THREE.Group();
  const dish = new THREE.Mesh(shape("cylinder", [radius * 0.86, height]), material(colour));
  const edge = new THREE.Mesh(shape("cylinder", [radius, height * 0.8]), material(rim));
  dish.position.z = height / 2 + 0.0005;
  edge.position.z = (height * 0.8) / 2;
  group.add(edge, dish);
  return group;
}

/** Return a block centred on its own origin. */
export function block({ size, colour }) {
  return new (three().Mesh)(shape("box", size), material(colour));
}
