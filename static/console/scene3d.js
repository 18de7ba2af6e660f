// The robot in 3D by the viewer script of meshcat: shapes once, then one matrix per part and frame.

import { Path } from "./scene_path.js";
import { block, ghostPaint, plate, robotParts, table, three } from "./scene_shapes.js";
import { Views } from "./scene_views.js";

const SIZE = 16; // numbers of a matrix
const PATH_COLOURS = ["#4fa3ff", "#f7a04b", "#46d17f", "#c79bff"];

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** `element` is filled by it; throws where the browser has no WebGL. */
export class Scene3D {
  #viewer;
  #views;
  #parts = [];
  #ghosts = [];
  #paths = [];
  #frames = [];
  #blocks = [];
  #plate = null;
  #geometry;
  #shown = { ghost: false, frames: false, path: true };
  #framed = false;

  constructor(element, geometry) {
    if (!window.MeshCat) throw new Error("the viewer script did not load");
    const renderer = drawing(element);
    this.software = drawnBySoftware(renderer);
    this.#viewer = new window.MeshCat.Viewer(element, undefined, renderer);
    this.#viewer.gui.domElement.remove();
    renderer.setPixelRatio(this.software ? 1 : Math.min(window.devicePixelRatio, 1.5));
    this.#fitTo(element);
    this.#views = new Views(this.#viewer);
    this.#geometry = geometry;
    this.#bench(geometry);
    this.#robot(geometry);
    document.addEventListener("eva:theme", () => this.#ground());
    if (geometry.home) this.setPoses(Float32Array.from(geometry.home.flat()), 1);
  }

  /** Where every part is: [count * P * 16]; the second of two is where it was told to be. */
  setPoses(numbers, count) {
    const size = this.#parts.length * SIZE;
    place(this.#parts, numbers, 0);
    if (count > 1) place(this.#ghosts, numbers, size);
    this.#show(this.#ghosts, this.#shown.ghost && count > 1);
    if (!this.#framed) this.#frame();
    this.#tips();
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

  /** "all", "front", "top", or "wrist", which goes on to the next arm each time. */
  view(name) {
    this.#views.show(name, this.#geometry.tips?.length ?? 0);
    this.#tips();
  }

  /** Show or hide "ghost", "frames" or "path"; returns whether it is shown now. */
  toggle(what) {
    this.#shown[what] = !this.#shown[what];
    this.#show(this.#paths.map((path) => path.object), this.#shown.path);
    this.#show(this.#frames, this.#shown.frames);
    if (what === "ghost") this.#show(this.#ghosts, this.#shown.ghost);
    this.#viewer.set_dirty();
    return this.#shown[what];
  }

  #add(path, object) {
    this.#viewer.set_object(path.split("/"), object);
    return object;
  }

  #show(objects, visible) {
    for (const object of objects) object.visible = visible;
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
    const THREE = three();
    this.#parts = robotParts(geometry);
    this.#ghosts = robotParts(geometry, ghostPaint);
    this.#parts.forEach((part, index) => this.#add(`robot/${index}`, part));
    this.#ghosts.forEach((part, index) => this.#add(`ghost/${index}`, part));
    this.#show(this.#ghosts, false);
    (geometry.tips ?? []).forEach((tip, index) => {
      const axes = new THREE.AxesHelper(0.08);
      axes.matrixAutoUpdate = false;
      axes.visible = false;
      this.#frames.push(this.#add(`frame/${index}`, axes));
      const path = new Path(PATH_COLOURS[index % PATH_COLOURS.length], css("--scene"));
      this.#paths.push(path);
      this.#add(`path/${index}`, path.object);
    });
  }

  /** What hangs on fingertips: their frames, their paths, the camera that follows one. */
  #tips() {
    (this.#geometry.tips ?? []).forEach((tip, index) => {
      const axes = this.#frames[index];
      axes.matrix.multiplyMatrices(this.#parts[tip.part].matrix, axes.matrix.clone().fromArray(tip.pose));
      axes.matrixWorldNeedsUpdate = true;
      const world = axes.matrix.elements;
      this.#paths[index].add(world[12], world[13], world[14]);
      if (this.#views.following === index) this.#views.follow(world);
    });
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

/** Edges are smoothed where a graphics card does it; in software that would cost more than all the rest. */
function drawing(element) {
  const THREE = three();
  let renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  if (drawnBySoftware(renderer)) {
    renderer.dispose();
    renderer.forceContextLoss();
    renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true });
  }
  element.append(renderer.domElement);
  return renderer;
}

function drawnBySoftware(renderer) {
  const gl = renderer.getContext();
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return names !== null && /swiftshader|llvmpipe|software/i.test(gl.getParameter(names.UNMASKED_RENDERER_WEBGL));
}

function place(groups, numbers, from) {
  groups.forEach((group, index) => {
    group.matrix.fromArray(numbers, from + index * SIZE);
    group.matrixWorldNeedsUpdate = true;
  });
}
