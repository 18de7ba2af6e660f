// The robot in 3D by the viewer script of meshcat: shapes once, then one matrix per part and frame.

import { ChunkDots } from "./scene_chunk.js";
import { Ghosts } from "./scene_ghosts.js";
import { Preview } from "./scene_preview.js";
import { lightenWork, rendererIn } from "./scene_renderer.js";
import { block, css, place, plate, robotParts, SIZE, table, three } from "./scene_shapes.js";
import { Tips } from "./scene_tips.js";
import { Views } from "./scene_views.js";

const STILL = 2e-5; // m, and about as much of a turn: less than a pixel

/** `element` is filled by it; throws where the browser has no WebGL. */
export class Scene3D {
  #viewer;
  #views;
  #parts;
  #ghosts;
  #tips;
  #dots = new ChunkDots();
  #preview = new Preview();
  #blocks = [];
  #plate = null;
  #geometry;
  #shown = { ghost: false, frames: false, path: true, chunk: true };
  #simulated = false;
  #drawn = new Float32Array(0); // the numbers of all parts as they were drawn last
  #framed = false;

  constructor(element, geometry) {
    if (!window.MeshCat) throw new Error("the viewer script did not load");
    const { renderer, software } = rendererIn(element);
    this.software = software;
    this.#viewer = new window.MeshCat.Viewer(element, undefined, renderer);
    this.#viewer.gui.domElement.remove();
    this.#fitTo(element);
    this.#views = new Views(this.#viewer);
    this.#geometry = geometry;
    this.#bench(geometry);
    this.#robot(geometry);
    document.addEventListener("eva:theme", () => this.#ground());
    if (geometry.home) this.setPoses(Float32Array.from(geometry.home.flat()), 1);
  }

  /** Where every part is: [count * P * 16]; the second is where it was told to be, the third a simulated robot. */
  setPoses(numbers, count) {
    const size = this.#parts.length * SIZE;
    const film = this.#preview.at(performance.now());
    if (!film && this.#framed && !this.#moved(numbers)) return; // drawn already, as it is
    place(this.#parts, numbers, 0);
    this.#ghosts.pose("commanded", count > 1 ? numbers : null, size);
    this.#ghosts.pose("simulated", count > 2 ? numbers : null, 2 * size);
    this.#ghosts.pose("chunk", film);
    if (!this.#framed) this.#frame();
    this.#follow();
    this.#viewer.set_dirty();
  }

  /** Where the things on a simulated bench are: {blocks: [[x, y, z, yaw]], plate: [x, y]}. */
  setBench({ blocks = [], plate: at }) {
    const { bench } = this.#geometry;
    if (!bench || !Array.isArray(at)) return;
    this.#plate ??= this.#add("bench/plate", plate(bench));
    this.#plate.position.set(at[0], at[1], 0);
    blocks.forEach(([x, y, z, yaw], index) => {
      this.#blocks[index] ??= this.#add(`bench/block${index}`, block(bench, index));
      this.#blocks[index].position.set(x, y, z);
      this.#blocks[index].rotation.set(0, 0, yaw);
    });
    this.#viewer.set_dirty();
  }

  /** A chunk's rows {state, targets, overlap, tips}, as dots; null: none. */
  setChunk(chunk) {
    this.#dots.show(this.#shown.chunk ? chunk : null);
    this.#viewer.set_dirty();
  }

  /** A proposed chunk as a robot that goes through it: matrices [N * P * 16] at `rows`, `period` s apart; null: none. */
  propose(rows, numbers, period) {
    if (numbers) this.#preview.begin(rows, numbers, period);
    else this.#preview.end();
    this.#ghosts.pose("chunk", this.#preview.at(performance.now()));
    this.#viewer.set_dirty();
  }

  /** Where the robot would go, [P * 16]; null: nowhere. */
  aim(numbers) {
    this.#ghosts.pose("aim", numbers);
    this.#viewer.set_dirty();
  }

  /** Whether that ghost is drawn now: "commanded", "aim", "chunk" or "simulated". */
  draws(ghost) {
    return this.#ghosts.visible(ghost);
  }

  /** "all", "front", "top", or "wrist", which goes on to the next arm each time. */
  view(name) {
    this.#views.show(name, this.#tips.count);
    this.#follow();
  }

  /** Show or hide "ghost" (the commanded pose), "frames", "path" or "chunk"; returns whether it is shown now. */
  toggle(what) {
    this.#shown[what] = !this.#shown[what];
    this.#tips.show(this.#shown.frames, this.#shown.path);
    this.#ghosts.allow("commanded", this.#shown.ghost);
    this.#ghosts.allow("chunk", this.#shown.chunk);
    if (!this.#shown.chunk) this.#dots.show(null);
    this.#drawn = new Float32Array(0); // what is shown now may never have been placed
    this.#viewer.set_dirty();
    return this.#shown[what];
  }

  #add(path, object) {
    if (this.software) lightenWork(object);
    this.#viewer.set_object(path.split("/"), object);
    return object;
  }

  /** The viewer measures the window; ours is a pane. */
  #fitTo(element) {
    const fit = this.#viewer.set_3d_pane_size.bind(this.#viewer);
    this.#viewer.set_3d_pane_size = () => {
      if (element.clientWidth && element.clientHeight) fit(element.clientWidth, element.clientHeight);
    };
    new ResizeObserver(() => this.#viewer.set_3d_pane_size()).observe(element);
    this.#viewer.set_3d_pane_size();
  }

  #bench(geometry) {
    this.#viewer.hide_background();
    this.#viewer.delete_path(["Axes"]);
    this.#ground();
    if (geometry.table) this.#add("bench/table", table(geometry.table));
  }

  #ground() {
    const THREE = three();
    const grid = new THREE.GridHelper(4, 40, css("--scene-grid"), css("--scene-grid"));
    grid.rotateX(Math.PI / 2);
    grid.position.z = -0.04;
    this.#add("Grid", grid);
    this.#viewer.set_dirty();
  }

  #robot(geometry) {
    const add = (path, object) => this.#add(path, object);
    this.#parts = robotParts(geometry);
    this.#parts.forEach((part, index) => add(`robot/${index}`, part));
    this.#ghosts = new Ghosts(geometry, add);
    this.#ghosts.allow("commanded", false);
    this.#tips = new Tips(geometry.tips ?? [], add);
    this.#dots.objects.forEach((points, index) => add(`chunk/${index}`, points));
  }

  /** Whether anything is elsewhere than it was drawn last. */
  #moved(numbers) {
    const before = this.#drawn;
    let same = numbers.length === before.length;
    for (let at = 0; same && at < numbers.length; at += 1) {
      same = Math.abs(numbers[at] - before[at]) <= STILL || Object.is(numbers[at], before[at]); // there may be NaN
    }
    if (!same) this.#drawn = numbers.slice();
    return !same;
  }

  /** The robot that acts: in a simulation the simulated one. */
  #follow() {
    const simulated = this.#ghosts.visible("simulated");
    if (simulated !== this.#simulated) this.#tips.forget();
    this.#simulated = simulated;
    this.#tips.move(simulated ? this.#ghosts.parts("simulated") : this.#parts);
    if (this.#views.following >= 0) this.#views.follow(this.#tips.world(this.#views.following));
  }

  /** Look at the whole robot, once it is known where it is. */
  #frame() {
    const THREE = three();
    const box = new THREE.Box3();
    const corner = new THREE.Vector3();
    const toZUp = new THREE.Matrix4().copy(this.#viewer.scene.matrixWorld).invert();
    this.#viewer.scene.updateMatrixWorld(true);
    for (const part of this.#parts) box.expandByObject(part);
    box.applyMatrix4(toZUp);
    const { table: desk, bench } = this.#geometry;
    if (bench) box.expandByPoint(corner.set(bench.area[0], bench.area[2], 0)).expandByPoint(corner.set(bench.area[1], bench.area[3], 0));
    const centre = box.getCenter(new THREE.Vector3());
    const radius = box.getSize(corner).length() / 2;
    const ahead = desk ? [desk.centre[0], desk.centre[1]] : [0, 1];
    const length = Math.hypot(...ahead) || 1;
    this.#views.frame(centre.toArray(), radius * 1.12, length > 1e-6 ? ahead.map((value) => value / length) : [0, 1]);
    this.#framed = true;
    this.view("all");
  }
}
