// Meshes from the server, parsed by the loaders inside the viewer's script: STL, OBJ and DAE.

import { three } from "./scene_shapes.js";

const WHITE = "data:image/gif;base64,R0lGODlhAQABAIAAAP///wAAACwAAAAAAQABAAACAkQBADs="; // replaces textures
const NO_TEXTURES = new Proxy({}, { get: () => WHITE });

/** Loads each address once, however often it is requested. */
export class Meshes {
  #viewer;
  #read = new Map(); // address -> promise

  constructor(viewer) {
    this.#viewer = viewer;
  }

  /** Resolve to {geometry, material}; the material is that of the file, or null if it has none. */
  get({ address, format }) {
    if (!this.#read.has(address)) {
      const coming = fetched(address).then((bytes) => this.#parsed(address, format, bytes));
      coming.catch(() => this.#read.delete(address)); // so that the next request tries again
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
    if (format === "stl") geometry.computeVertexNormals(); // many files leave the normals zero
    const metres = format === "dae" ? unit(bytes) : 1;
    geometry.scale(metres, metres, metres); // the loader leaves this scaling to its user
    return { geometry, material: format === "dae" ? material : null };
  }
}

async function fetched(address) {
  const response = await fetch(address, { credentials: "same-origin", redirect: "error" });
  if (!response.ok) throw new Error(`HTTP ${response.status}`);
  return new Uint8Array(await response.arrayBuffer());
}

const text = (bytes) => new TextDecoder().decode(bytes);

/** Return the length of a COLLADA file's unit [m]. */
function unit(bytes) {
  const found = /<unit\b[^>]*\bmeter\s*=\s*["']([^"']+)["']/.exec(text(bytes));
  return found ? Number(found[1]) : 1;
}

/** Return the file in the form of the viewer's command "set_object". */
function description(format, bytes) {
  const whole = { metadata: { version: 4.5, type: "Object" } };
  if (format === "dae") {
    return { ...whole, object: { uuid: "mesh", type: "_meshfile_object", format, data: text(bytes), resources: NO_TEXTURES } };
  }
  const geometry = { uuid: "shape", type: "_meshfile_geometry", format, data: format === "stl" ? bytes : text(bytes) };
  const look = { uuid: "look", type: "MeshPhongMaterial" };
  return { ...whole, geometries: [geometry], materials: [look], object: { uuid: "mesh", type: "Mesh", geometry: "shape", material: "look" } };
}

/**
 * Replace `box`, the placeholder, by the mesh of `visual`; `changed(mesh)` is called when it has been loaded. If it cannot be
 * loaded, the box stays.
 */
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
