// Where a chunk of actions takes the fingertips: a dot per row and arm, and a ring at its seam, the first row that is executed.

import { ARM_COLOURS } from "./scene_tips.js";
import { three } from "./scene_shapes.js";

const DOT = 7; // px
const RING = 17;
const IDLE = "#8793a0"; // of rows that are not executed
const PALE = 0.55; // how far the colour of rows that are blended with the previous plan is mixed with white

/**
 * Return what happens to the rows of a chunk: {seam, looks}. `seam` is the first row that is executed (-1 for none); `looks`
 * says "idle", "blended" or "own" for each row. All rows of a proposed chunk are its own, and its seam is its first row.
 */
export function rowsOf({ state, targets, overlap = 0 }) {
  if (state === "proposed") return { seam: 0, looks: targets.map(() => "own") };
  const seam = state === "dropped" ? -1 : targets.findIndex((step) => step >= 0);
  const until = seam < 0 ? -1 : targets[seam] + overlap;
  const look = (step) => (step < 0 || seam < 0 ? "idle" : step < until ? "blended" : "own");
  return { seam, looks: targets.map(look) };
}

export class ChunkDots {
  #dots = points(DOT, disc);
  #rings = points(RING, ring);
  objects = [this.#dots, this.#rings];

  /** Draw the `tips` [H * arms * 3] of a chunk; null draws nothing. */
  show(chunk) {
    const { targets, tips } = chunk ?? {};
    const count = tips?.length ? targets.length : 0;
    fit(this.#dots, count ? tips.length / 3 : 0);
    if (!count) return fit(this.#rings, 0);
    const arms = tips.length / 3 / count;
    const { seam, looks } = rowsOf(chunk);
    this.#write(tips, looks, arms);
    this.#mark(tips, seam, arms);
  }

  #write(tips, looks, arms) {
    const { position, color } = this.#dots.geometry.attributes;
    position.array.set(tips);
    const palette = colours(arms);
    looks.forEach((look, row) => {
      for (let arm = 0; arm < arms; arm += 1) {
        const { r, g, b } = palette[look][arm];
        color.setXYZ(row * arms + arm, r, g, b);
      }
    });
    position.needsUpdate = color.needsUpdate = true;
  }

  #mark(tips, seam, arms) {
    fit(this.#rings, seam < 0 ? 0 : arms);
    if (seam < 0) return;
    const { position, color } = this.#rings.geometry.attributes;
    for (let arm = 0; arm < arms; arm += 1) {
      position.setXYZ(arm, ...tips.subarray((seam * arms + arm) * 3, (seam * arms + arm) * 3 + 3));
      color.setXYZ(arm, 1, 1, 1);
    }
    position.needsUpdate = color.needsUpdate = true;
  }
}

function colours(arms) {
  const { Color } = three();
  const own = Array.from({ length: arms }, (_, arm) => new Color(ARM_COLOURS[arm % ARM_COLOURS.length]));
  const white = new Color("#ffffff");
  return { own, blended: own.map((colour) => colour.clone().lerp(white, PALE)), idle: own.map(() => new Color(IDLE)) };
}

function points(size, draw) {
  const THREE = three();
  const look = { size, vertexColors: true, sizeAttenuation: false, map: picture(draw), transparent: true, alphaTest: 0.4, depthTest: false };
  const made = new THREE.Points(new THREE.BufferGeometry(), new THREE.PointsMaterial(look));
  made.frustumCulled = false;
  made.renderOrder = 1; // drawn over the robot, which must not hide what it will do
  made.visible = false;
  return made;
}

/** Make room for `count` points and draw that many; the buffers only ever grow. */
function fit(object, count) {
  const THREE = three();
  const { geometry } = object;
  if (count > (geometry.attributes.position?.count ?? 0)) {
    for (const name of ["position", "color"]) geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(count * 6), 3));
  }
  geometry.setDrawRange(0, count);
  object.visible = count > 0;
}

function picture(draw) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 32;
  const ctx = canvas.getContext("2d");
  ctx.fillStyle = ctx.strokeStyle = "#ffffff";
  draw(ctx);
  return new (three().CanvasTexture)(canvas);
}

function disc(ctx) {
  ctx.arc(16, 16, 15, 0, 2 * Math.PI);
  ctx.fill();
}

function ring(ctx) {
  ctx.lineWidth = 5;
  ctx.arc(16, 16, 12.5, 0, 2 * Math.PI);
  ctx.stroke();
}
