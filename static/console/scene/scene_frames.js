// Frames as small triads (x red, y green, z blue): those of the end effectors, and those in which their poses are given.

import { shape, three } from "./scene_shapes.js";

const AXES = [
  { colour: "#ff5a52", turn: [0, Math.PI / 2, 0] },
  { colour: "#4fce5d", turn: [-Math.PI / 2, 0, 0] },
  { colour: "#5b9bff", turn: [0, 0, 0] },
];
const LENGTH = { end: 0.075, reference: 0.13 }; // m
const THICK = 0.0026; // radius [m]
const LABEL = 0.023; // height of a name, as a share of about the view's height
const BELOW = [0.5, 1.6]; // position of the frame relative to its name's box, which is 1 wide and 1 high
const ABOVE = [1.05, -0.5];

export class Frames {
  #frames; // [{part, pose}] from the server
  #offsets;
  #triads;
  #moving;

  /**
   * `frames` is [{name, kind, part, pose}]; part is null for a frame that does not move. `add` puts an object into the scene.
   */
  constructor(frames, add) {
    const THREE = three();
    this.#frames = frames;
    this.#offsets = frames.map(({ pose }) => new THREE.Matrix4().fromArray(pose));
    this.#triads = frames.map((frame, index) => add(`frame/${index}`, triad(frame)));
    this.#triads.forEach((triad, index) => {
      triad.matrix.copy(this.#offsets[index]);
      triad.matrixWorldNeedsUpdate = true;
    });
    this.show(false);
  }

  show(shown) {
    for (const triad of this.#triads) triad.visible = shown;
  }

  /** Move the frames with the robot's `parts` (its groups). */
  move(parts) {
    this.#frames.forEach(({ part }, index) => {
      if (part === null) return;
      const triad = this.#triads[index];
      triad.matrix.multiplyMatrices(parts[part].matrix, this.#offsets[index]);
      triad.matrixWorldNeedsUpdate = true;
    });
  }
}

/** Return a triad, drawn over the robot, because an end effector's frame lies inside it. */
function triad({ name, kind, part }) {
  const THREE = three();
  const group = new THREE.Group();
  group.matrixAutoUpdate = false;
  const length = LENGTH[kind];
  for (const { colour, turn } of AXES) {
    const look = { color: colour, depthTest: false, transparent: true };
    const axis = new THREE.Mesh(shape("cylinder", [THICK, length]), new THREE.MeshBasicMaterial(look));
    const arm = new THREE.Group();
    axis.position.z = length / 2;
    axis.renderOrder = 3;
    arm.add(axis);
    arm.rotation.set(...turn);
    group.add(arm);
  }
  group.add(label(name, part === null ? ABOVE : BELOW));
  return group;
}

function label(name, beside) {
  const THREE = three();
  const canvas = document.createElement("canvas");
  const ctx = canvas.getContext("2d");
  const font = "500 22px system-ui, sans-serif";
  ctx.font = font;
  canvas.width = Math.ceil(ctx.measureText(name).width) + 14;
  canvas.height = 32;
  ctx.font = font;
  ctx.fillStyle = "rgb(12 18 24 / 72%)";
  ctx.roundRect(0, 0, canvas.width, canvas.height, 6);
  ctx.fill();
  ctx.fillStyle = "#e8eef4";
  ctx.fillText(name, 7, 23);
  const look = { map: new THREE.CanvasTexture(canvas), depthTest: false, transparent: true, sizeAttenuation: false };
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial(look));
  sprite.scale.set((LABEL * canvas.width) / canvas.height, LABEL, 1);
  sprite.center.set(...beside);
  sprite.renderOrder = 4;
  return sprite;
}
