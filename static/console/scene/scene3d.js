// The robot in 3D with meshcat's viewer script: the shapes are sent once, then one matrix per part and frame.

import { block, disc, ground, mount, table } from "./scene_bench.js";
import { Capsules } from "./scene_capsules.js";
import { ChunkDots } from "./scene_chunk.js";
import { Frames } from "./scene_frames.js";
import { Ghosts } from "./scene_ghosts.js";
import { Meshes } from "./scene_meshes.js";
import { Preview } from "./scene_preview.js";
import { lightenWork, rendererIn } from "./scene_renderer.js";
import { place, robotParts, SIZE } from "./scene_robot.js";
import { three } from "./scene_shapes.js";
import { Tips } from "./scene_tips.js";
import { Views } from "./scene_views.js";
import { t } from "../../site/sentences.js";

const STILL = 2e-5; // m, and about as much for a rotation: less than a pixel
const OURS = ["bench", "robot", "ghost", "capsules", "frame", "path", "chunk"];

/** The 3D scene in `element`; throws if the browser has no WebGL. */
export class Scene3D {
  #viewer;
  #views;
  #meshes;
  #parts = [];
  #ghosts;
  #tips;
  #frames;
  #capsules;
  #dots = new ChunkDots();
  #preview = new Preview();
  #blocks = [];
  #discs = [];
  #looks = null; // of the objects that are drawn
  #varied = ""; // and how a factor has changed them
  #lies = "";
  #geometry = null;
  #shown = { ghost: false, frames: false, path: true, chunk: true, capsules: false };
  #simulated = false;
  #drawn = new Float32Array(0); // the numbers of all parts as they were last drawn
  #framed = false;

  constructor(element) {
    if (!window.MeshCat) throw new Error(t("page.scene3d.no_script", "the viewer script did not load"));
    const { renderer, software } = rendererIn(element);
    this.software = software;
    this.#viewer = new window.MeshCat.Viewer(element, undefined, renderer);
    this.#viewer.gui.domElement.remove();
    renderer.domElement.addEventListener("webglcontextrestored", () => this.#viewer.set_dirty());
    this.#viewer.hide_background();
    this.#viewer.delete_path(["Axes"]);
    this.#fitTo(element);
    this.#views = new Views(this.#viewer);
    this.#meshes = new Meshes(this.#viewer);
    document.addEventListener("eva:theme", () => this.#ground());
  }

  /** Draw the robot and the bench of `geometry`, and remove what was drawn before. */
  show(geometry) {
    for (const path of OURS) this.#viewer.delete_path([path]);
    this.#geometry = geometry;
    this.#clearBench();
    this.#drawn = new Float32Array(0);
    this.#framed = false;
    this.#preview.end();
    this.#bench(geometry);
    this.#robot(geometry);
    if (geometry.home) this.setPoses(Float32Array.from(geometry.home.flat()), 1);
  }

  /** Set the matrices of every part, [count * P * 16]: the measured robot, then the commanded one, then a simulated one. */
  setPoses(numbers, count) {
    const size = this.#parts.length * SIZE;
    if (numbers.length !== count * size) return; // of the robot in other groups, whose shapes are being fetched
    const film = this.#preview.at(performance.now());
    if (!film && this.#framed && !this.#moved(numbers)) return; // already drawn like this
    place(this.#parts, numbers, 0);
    this.#ghosts.pose("commanded", count > 1 ? numbers : null, size);
    this.#ghosts.pose("simulated", count > 2 ? numbers : null, 2 * size);
    this.#ghosts.pose("chunk", film);
    if (!this.#framed) this.#frame();
    this.#follow();
    this.#viewer.set_dirty();
  }

  #clearBench() {
    this.#blocks.forEach((_, index) => this.#viewer.delete_path(["bench", `block${index}`]));
    this.#discs.forEach((_, index) => this.#viewer.delete_path(["bench", `disc${index}`]));
    this.#blocks = [];
    this.#discs = [];
    this.#lies = "";
  }

  /**
   * Place the objects on a simulated bench: {blocks: [[x, y, z, yaw]], plate: [x, y]}, or {blocks, discs: [[x, y]]} with several
   * discs. `looks` says how they look, as runtime.benches.appearance; without it, the geometry does. `edges` [m] and
   * `colours` (0 to 255) say it of each block where a factor of the trial has changed them.
   */
  setBench(
    { blocks = [], plate, discs = Array.isArray(plate) ? [plate] : [], edges, colours },
    looks = this.#geometry?.bench,
  ) {
    if (!looks || !this.#geometry || !discs.length) return;
    const varied = JSON.stringify([edges, colours]);
    if (looks !== this.#looks || varied !== this.#varied) {
      this.#clearBench();
      this.#looks = looks;
      this.#varied = varied;
    }
    const lies = JSON.stringify([blocks, discs]);
    if (lies === this.#lies) return; // already drawn like this
    this.#lies = lies;
    discs.forEach(([x, y], index) => {
      this.#discs[index] ??= this.#add(`bench/disc${index}`, disc(looks.discs[index % looks.discs.length]));
      this.#discs[index].position.set(x, y, 0);
    });
    while (this.#blocks.length > blocks.length) {
      this.#blocks.pop();
      this.#viewer.delete_path(["bench", `block${this.#blocks.length}`]);
    }
    blocks.forEach(([x, y, z, yaw], index) => {
      this.#blocks[index] ??= this.#add(`bench/block${index}`, block(this.#appearanceOf(looks, edges, colours, index)));
      this.#blocks[index].position.set(x, y, z);
      this.#blocks[index].rotation.set(0, 0, yaw);
    });
    this.#viewer.set_dirty();
  }

  #appearanceOf(looks, edges, colours, index) {
    const usual = looks.blocks[index % looks.blocks.length];
    if (!edges || !colours) return usual;
    const edge = edges[index];
    return { size: [edge, edge, edge], colour: [...colours[index].map((part) => part / 255), 1] };
  }

  /** Draw a chunk's rows {state, targets, overlap, tips} as dots; null draws none. */
  setChunk(chunk) {
    this.#dots.show(this.#shown.chunk ? chunk : null);
    this.#viewer.set_dirty();
  }

  /**
   * Animate a proposed chunk as a ghost that moves through it: matrices [N * P * 16] at the rows `rows`, where rows are
   * `period` s apart; null ends it.
   */
  propose(rows, numbers, period) {
    if (numbers) this.#preview.begin(rows, numbers, period);
    else this.#preview.end();
    this.#ghosts.pose("chunk", this.#preview.at(performance.now()));
    this.#viewer.set_dirty();
  }

  /** Draw the ghost of a target, matrices [P * 16]; null removes it. */
  aim(numbers) {
    this.#ghosts.pose("aim", numbers);
    this.#viewer.set_dirty();
  }

  /** Return whether that ghost is drawn now: "commanded", "aim", "chunk" or "simulated". */
  draws(ghost) {
    return this.#ghosts.visible(ghost);
  }

  /** Show the view "all", "front" or "top", or "wrist", which moves on to the next arm at each call. */
  view(name) {
    this.#views.show(name, this.#tips.count);
    this.#follow();
  }

  /** Show or hide "ghost" (the commanded pose), "frames", "path", "chunk" or "capsules"; return whether it is now shown. */
  toggle(what) {
    this.#shown[what] = !this.#shown[what];
    this.#apply();
    if (!this.#shown.chunk) this.#dots.show(null);
    this.#drawn = new Float32Array(0); // what is shown now may never have been placed
    this.#viewer.set_dirty();
    return this.#shown[what];
  }

  #apply() {
    const { ghost, frames, path, chunk, capsules } = this.#shown;
    this.#tips.show(path);
    this.#frames.show(frames);
    this.#capsules.show(capsules);
    this.#ghosts.allow("commanded", ghost);
    this.#ghosts.allow("chunk", chunk);
  }

  #add(path, object) {
    if (this.software) lightenWork(object);
    this.#viewer.set_object(path.split("/"), object);
    return object;
  }

  /** Size the viewer by `element` instead of the window, and keep in view what was in view. */
  #fitTo(element) {
    const fit = this.#viewer.set_3d_pane_size.bind(this.#viewer);
    this.#viewer.set_3d_pane_size = () => {
      if (!element.clientWidth || !element.clientHeight) return;
      fit(element.clientWidth, element.clientHeight);
      this.#views?.again();
    };
    new ResizeObserver(() => this.#viewer.set_3d_pane_size()).observe(element);
    this.#viewer.set_3d_pane_size();
  }

  #bench(geometry) {
    this.#ground();
    if (geometry.table) this.#add("bench/table", table(geometry.table));
    geometry.mounts?.forEach((one, index) => this.#add(`bench/mount${index}`, mount(one)));
  }

  #ground() {
    this.#add("Grid", ground(this.#geometry?.floor));
    this.#viewer.set_dirty();
  }

  #robot(geometry) {
    const add = (path, object) => this.#add(path, object);
    const changed = (mesh) => {
      if (this.software) lightenWork(mesh);
      this.#viewer.set_dirty();
    };
    const drawing = { meshes: this.#meshes, changed };
    this.#parts = robotParts(geometry, drawing);
    this.#parts.forEach((part, index) => add(`robot/${index}`, part));
    this.#ghosts = new Ghosts(geometry, add, drawing);
    this.#tips = new Tips(geometry.tips ?? [], add);
    this.#frames = new Frames(geometry.frames ?? [], add);
    this.#capsules = new Capsules(geometry.capsules ?? [], add);
    this.#dots.objects.forEach((points, index) => add(`chunk/${index}`, points));
    this.#apply();
  }

  /** Return whether any part has moved since it was last drawn. */
  #moved(numbers) {
    const before = this.#drawn;
    let same = numbers.length === before.length;
    for (let at = 0; same && at < numbers.length; at += 1) {
      same = Math.abs(numbers[at] - before[at]) <= STILL || Object.is(numbers[at], before[at]); // NaN equals NaN here
    }
    if (!same) this.#drawn = numbers.slice();
    return !same;
  }

  /** Let paths, frames, capsules and camera follow the robot that acts: in a simulation the simulated one. */
  #follow() {
    const simulated = this.#ghosts.visible("simulated");
    if (simulated !== this.#simulated) this.#tips.forget();
    this.#simulated = simulated;
    const acting = simulated ? this.#ghosts.parts("simulated") : this.#parts;
    for (const hung of [this.#tips, this.#frames, this.#capsules]) hung.move(acting);
    if (this.#views.following >= 0) this.#views.follow(this.#tips.world(this.#views.following));
  }

  /** Show the whole robot, in its present pose and in its named poses, and the bench. */
  #frame() {
    const { Box3, Matrix4, Vector3 } = three();
    const { view, ahead, floor } = this.#geometry;
    const box = new Box3();
    this.#viewer.scene.updateMatrixWorld(true);
    for (const part of this.#parts) box.expandByObject(part);
    box.applyMatrix4(new Matrix4().copy(this.#viewer.scene.matrixWorld).invert());
    for (const corner of [view.low, view.high]) box.expandByPoint(new Vector3(...corner));
    this.#views.frame(box.min.toArray(), box.max.toArray(), ahead, floor !== null);
    this.#framed = true;
    this.view("all");
  }
}
