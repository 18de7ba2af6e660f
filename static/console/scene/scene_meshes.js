// Meshes of the server, read by the loaders that are inside the viewer's script: STL, OBJ and DAE.

import { three } from "./scene_shapes.js";

const WHITE = "data:image/gif;base64,R0lGODlhAQABAIAAAP///wAAACwAAAAAAQABAAACAkQBADs="; // in place of textures
const NO_TEXTURES = new Proxy({}, { get: () => WHITE });

/** Reads each address once, whoever asks for it. */
export class Meshes {
  #viewer;
  #read = new Map(); // by address: promises

  constructor(viewer) {
    this.#viewer = viewer;
  }

  /** Resolves to {geometry, material}; the material is the file's own, null where it has none. */
  get({ address, format }) {
    if (!this.#read.has(address)) {
      const coming = fetched(address).then((bytes) => this.#parsed(address, format, bytes));
      coming.catch(() => this.#read.delete(address)); // the next one may try again
      this.#read.set(address, coming);
    }
    return this.#read.get(address);
  }

  #parsed(address, format, bytes) {
    const path = ["meshes", address];
    this.#viewer.set_object_from_json(path, description(format, bytes));
    const { geometry, material } = this.#viewer.scene_tree.find([...path, "<object>"]).object;
    this.#viewer.delete_path(path);
    if (!geometry?.attributes.position?.count) throw new Error(`a ${format} file without triangles`);
    if (format === "stl") geometry.computeVertexNormals(); // many files leave them zero
    const metres = format === "dae" ? unit(bytes) : 1;
    geometry.scale(metres, metres, metres); // which the loader leaves to who draws it
    return { geometry, material: format === "dae" ? material : null };
  }
}

async function fetched(address) {
  const response = await fetch(address, { credentials: "same-origin", redirect: "error" });
  if (!response.ok) throw new Error(`HTTP ${response.status}`);
  return new Uint8Array(await response.arrayBuffer());
}

const text = (bytes) => new TextDecoder().decode(bytes);

/** The length of a COLLADA file's unit [m]. */
function unit(bytes) {
  const found = /<unit\b[^>]*\bmeter\s*=\s*["']([^"']+)["']/.exec(text(bytes));
  return found ? Number(found[1]) : 1;
}

/** The file as the viewer's command "set_object" carries it. */
function description(format, bytes) {
  const whole = { metadata: { version: 4.5, type: "Object" } };
  if (format === "dae") {
    return { ...whole, object: { uuid: "mesh", type: "_meshfile_object", format, data: text(bytes), resources: NO_TEXTURES } };
  }
  const geometry = { uuid: "shape", type: "_meshfile_geometry", format, data: format === "stl" ? bytes : text(bytes) };
  const look = { uuid: "look", type: "MeshPhongMaterial" };
  return { ...whole, geometries: [geometry], materials: [look], object: { uuid: "mesh", type: "Mesh", geometry: "shape", material: "look" } };
}

/** The mesh of `visual` in place of `box`, which stands for it until then; `changed(mesh)` hears when it is there. */
export async function exchange(meshes, visual, box, paint, changed) {
  try {
    const { geometry, material } = await meshes.get(visual);
    const THREE = three();
    const mesh = new THREE.Mesh(geometry, paint ?? (visual.own_colours && material ? material : box.material));
    mesh.matrixAutoUpdate = false;
    mesh.matrix.fromArray(visual.origin).scale(new THREE.Vector3(...visual.size));
    box.parent.add(mesh);
    box.parent.remove(box);
    changed(mesh);
  } catch (error) {
    console.error(`a mesh is drawn as a box: ${error.message}`);
  }
}
